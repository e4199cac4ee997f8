"""The live loop: tracking in the caller's process, everything else in processes of its own."""
