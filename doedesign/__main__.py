"""`python -m doedesign`, which is also the command `doedesign`."""

import sys


def main() -> int:
    """Load the commands and run the one that is asked for; return the exit code."""
    try:
        from doedesign.cli import main as run
    except KeyboardInterrupt:  # loading them takes a moment
        print("doedesign: interrupted before anything was done", file=sys.stderr)
        return 130
    return run()


if __name__ == "__main__":
    sys.exit(main())
