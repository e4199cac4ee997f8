"""What a run looks like in Rerun: recorded to a file, served to a browser, or shown."""
