"""Run the command line as `python -m probewise`."""

import sys

from probewise.cli import main

if __name__ == "__main__":
    sys.exit(main())
