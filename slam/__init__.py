"""The system: sequences, front end, tracking, keyframes, runner and command line."""

__version__ = "0.1.0"
