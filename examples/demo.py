"""Train a gallop, test the robustness of two trots, deploy a trot on an emulated robot (four minutes on two cores).

1. `surefoot train gallop`: a short training, with its evaluation, figures and video in runs/.
2. `surefoot evaluate trot-robust --randomize table1`: the robust trot on randomized robots.
3. `surefoot evaluate sensitivity trot trot-robust`: which parameters make a trot fail that was trained without
   randomization, and one that was trained with it.
4. `surefoot emulate`, `doctor`, `deploy`, `gap`: a trot on an emulated robot, in another physics engine and in real
   time, compared with its simulation.

Arguments are passed to the training, so `--steps 200000` makes it shorter.
"""

import sys
from pathlib import Path

from deploy_on_emulator import other_world, show

from surefoot.cli.main import main

OUT = "out/demo"
GALLOP = ("--seed", "1", "--steps", "1000000", "--evaluate-every", "100000")
COMMANDS = (
    ["train", "gallop", "--name", "demo", *GALLOP, *sys.argv[1:]],
    ["evaluate", "trot-robust", "--randomize", "table1", "--episodes", "20", "--out", f"{OUT}/trot-robust"],
    ["evaluate", "sensitivity", "trot", "trot-robust", "--episodes", "4", "--out", f"{OUT}/sensitivity"],
    ["show", "trot-robust", "--out", f"{OUT}/trot-robust.mp4"],
)

if __name__ == "__main__":
    for command in COMMANDS:
        print(f"\n$ surefoot {' '.join(command)}", flush=True)
        code = main(command)
        if code:
            raise SystemExit(code)
    raise SystemExit(show("trot-robust", other_world(), 3, Path(OUT) / "deployed"))
