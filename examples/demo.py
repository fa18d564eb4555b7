"""The demonstration: learn the trot, evaluate it, draw it. Some three minutes on two cores.

Arguments are passed on to `surefoot train trot`, so `--steps 200000` makes a shorter one.
"""

import sys

from surefoot.cli.main import main

if __name__ == "__main__":
    # One learning thread: the same trot on any number of cores, the one that ships.
    raise SystemExit(main(["train", "trot", "--name", "demo", "--learning-threads", "1", *sys.argv[1:]]))
