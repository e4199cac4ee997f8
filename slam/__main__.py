"""``python -m bmask_slam``: the command line."""

import sys

from bmask_slam.cli import main

if __name__ == "__main__":
    sys.exit(main())
