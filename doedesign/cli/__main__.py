"""`python -m doedesign.cli`."""

import sys

from doedesign.cli import main

if __name__ == "__main__":
    sys.exit(main())
