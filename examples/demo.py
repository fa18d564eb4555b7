"""The demonstration: learn the trot, evaluate it, draw it. About ten minutes on two cores.

Arguments are passed on to `surefoot train trot`, so `--steps 200000` makes a shorter one.
"""

import sys

from surefoot.cli.main import main

if __name__ == "__main__":
    raise SystemExit(main(["train", "trot", "--name", "demo", *sys.argv[1:]]))
