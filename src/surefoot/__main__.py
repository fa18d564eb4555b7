"""Entry point of `python -m surefoot`."""

import sys

from surefoot.cli.main import program

if __name__ == "__main__":
    sys.exit(program())
