"""The map: keyframes, landmarks, frame history, and how the front end reads and edits them."""
