"""Command lines that are rejected in one line, and the files that they use."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from shipped_variants import maxitaur, modified_policy

from surefoot.robot import RobotDescription
from surefoot.task.trace import EpisodeTrace

REPOSITORY = Path(__file__).resolve().parents[1]
DDS = "--link dds --interface lo"


@dataclass(frozen=True)
class RejectedCommand:
    """Command line that ends with one line on standard error, without writing a file."""

    line: str
    """Arguments of `surefoot`; files named in `FILES` are created first, REPOSITORY is the folder of the clone."""
    parts: tuple[str, ...]
    """Texts in the line on standard error."""
    needs: tuple[str, ...] = ()
    """Packages that are required for this message."""
    hidden: str = ""
    """Package that is hidden, as if it were not installed."""


def rejected(
    command: str, lines: dict[str, str | tuple[str, ...]], *needs: str, hidden: str = ""
) -> list[RejectedCommand]:
    """Return rejected command lines of a command, from a dict of their other arguments."""
    return [
        RejectedCommand(f"{command} {words}".strip(), (parts,) if isinstance(parts, str) else parts, needs, hidden)
        for words, parts in lines.items()
    ]


# Files: their text, or a function that writes them with the fixture `make_run`.

MakeRun = Callable[..., EpisodeTrace]
Change = Callable[[dict[str, Any]], object]


def modify_contract(change: Change, name: str = "trot") -> Callable[[Path, MakeRun], object]:
    """Return a function that writes a released policy with a modified contract."""
    return lambda path, make_run: modified_policy(path, change, name)


def modify_values(**values: Any) -> Callable[[Path, MakeRun], object]:
    """Return a function that writes the trot with other values in its contract; `task` updates the task."""

    def change(contract: dict[str, Any]) -> None:
        contract |= values | {"task": contract["task"] | values.get("task", {})}

    return modify_contract(change)


def exchange_columns(contract: dict[str, Any]) -> None:
    names = contract["columns"]
    names[4], names[5] = names[5], names[4]


def widen_feedback(contract: dict[str, Any]) -> None:
    contract["low"] = [-0.8] * 4 + [-0.25] * 4


def write_policy_of_maxitaur(path: Path, make_run: MakeRun) -> None:
    robot = maxitaur(path.parent / "maxitaur")
    modified_policy(path, lambda contract: contract.update(robot="maxitaur", description=str(robot)), "trot")


def write_stale_policy(path: Path, make_run: MakeRun) -> None:
    """Write the trot with another rate and the old digest."""
    text = (REPOSITORY / "policies/trot.onnx").read_bytes()
    path.write_bytes(text.replace(b'"control_step": 0.006', b'"control_step": 0.012'))


def write_unnormalized_policy(path: Path, make_run: MakeRun) -> None:
    """Write the trot without its first two nodes and with the old digest."""
    import onnx

    model = onnx.load(REPOSITORY / "policies/trot.onnx")
    model.graph.node[2].input[0] = "observation"
    del model.graph.node[:2]
    onnx.save(model, path)


def write_their_network(path: Path, make_run: MakeRun) -> None:
    from third_party_policies import MJLAB_PROPERTIES, perceptron

    path.write_bytes(perceptron(45, properties=MJLAB_PROPERTIES))


def resting_run(**meta: Any) -> Callable[[Path, MakeRun], object]:
    """Return a function that writes a run in which nothing moves."""
    return lambda path, make_run: make_run(**meta).save(path)


def swinging_run(**meta: Any) -> Callable[[Path, MakeRun], object]:
    """Return a function that writes a run in which legs swing."""

    def write(path: Path, make_run: MakeRun) -> None:
        from recordings import swinging

        swinging(make_run, **meta).trace.save(path)

    return write


def write_traces_of_two_worlds(path: Path, make_run: MakeRun) -> None:
    for world in ("bullet", "lab"):
        make_run(world=world, policy="gallop").save(path / f"{world}.npz")


def write_cut_trace(path: Path, make_run: MakeRun) -> None:
    make_run().save(path)
    path.write_bytes(path.read_bytes()[:1000])


def write_short_log(path: Path, make_run: MakeRun) -> None:
    command = np.zeros((5, 12))
    command[:, 1] = np.arange(5) / 10
    np.savez(path, time=0.01 * np.arange(5), command=command, motor_angle=command)


def write_map(path: Path, make_run: MakeRun) -> None:
    np.savez(path, heights=np.zeros((41, 41)), cell=0.1)


FOOT = "reference: {kind: foot}\n"
GROUP = "groups: {a: {}}"
FILES: dict[str, str | Callable[[Path, MakeRun], object]] = {
    # Tasks.
    "name.yaml": "name: ../../x\n",
    "key.yaml": "observation: [roll]\n",
    "speed.yaml": "speed: 3\n",
    "digits.yaml": f"fall_angle: {'9' * 6000}\n",
    "large.yaml": f"fall_angle: 1{'0' * 400}\n",
    "list.yaml": "train: [1]\n",
    "ranges.yaml": "randomize: {voltage: [16, 15]}\n",
    "long-legs.yaml": "reference: {kind: sine, extension: {amplitude: 2.0, frequency: 2.0, offset: 1.6}}\n",
    # Handcrafted gaits.
    "foot.yaml": FOOT,
    "hand.yaml": f"{FOOT}handcrafted: {{}}\n",
    "deep.yaml": f"{FOOT}handcrafted: {{about: {{parameters: {{depth: deep}}}}}}\n",
    # Studies.
    "study.yaml": "{name: tiny, task: trot, seeds: [0], groups: {plain: {}, drawn: {}}, evaluate: [sensitivity]}\n",
    "study-name.yaml": f"{{name: ../../x, {GROUP}}}\n",
    "study-kind.yaml": f"{{{GROUP}, evaluate: [luck]}}\n",
    "study-gaps.yaml": f"{{{GROUP}, evaluate: [gap, gap_test]}}\n",
    "study-primary.yaml": f"{{{GROUP}, primary: gap}}\n",
    "study-bars.yaml": f"{{{GROUP}, bars: {{all: [a]}}}}\n",
    "study-robot.yaml": "groups: {a: {train: {task: {observations: [smell]}}}}\n",
    # Search spaces.
    "space-key.yaml": "ppo.leg: {low: 0, high: 1}\n",
    "space-reversed.yaml": "ppo.gamma: {low: 0.9, high: 0.8}\n",
    "space-robot.yaml": "task.robot: {choices: [minitaur, centipede]}\n",
    # Physical parameters.
    "cat.toml": 'robot = "cat"\n[params]\nvoltage = 15\n',
    "range.toml": "[params]\nmotor_strength = [1, 1, 1, 9, 1, 1, 1, 1]\n",
    "short.toml": "[params]\nmotor_strength = [1, 0.9]\n",
    "step.toml": "[params]\ncontrol_step = 0.008\n",
    # Policies.
    "columns.onnx": modify_contract(exchange_columns, "gallop"),
    "wide.onnx": modify_contract(widen_feedback),
    "nan.onnx": modify_values(control_latency=float("nan")),
    "early.onnx": modify_values(control_latency=-0.02),
    "tilting.onnx": modify_values(task={"fall_angle": 1e9}),
    "odd.onnx": modify_values(name="a/b c"),
    "above.onnx": modify_values(name=".."),
    "outside.onnx": modify_values(name="../../x"),
    "maxitaur.onnx": write_policy_of_maxitaur,
    "stale.onnx": write_stale_policy,
    "unnormalized.onnx": write_unnormalized_policy,
    "cut.onnx": lambda path, make_run: path.write_bytes((REPOSITORY / "policies/trot.onnx").read_bytes()[:500]),
    "theirs.onnx": write_their_network,
    # Recorded runs and logs.
    "run.npz": swinging_run(),
    "foreign.npz": resting_run(robot="nemo/../evil"),
    "other-motors.npz": resting_run(),
    "cut.npz": write_cut_trace,
    "two-worlds": write_traces_of_two_worlds,
    "short.npz": write_short_log,
    "pupper.npz": lambda path, make_run: shutil.copy(REPOSITORY / "data/pupper_v2/one_hip_200hz.npz", path),
    "no-logs": lambda path, make_run: path.mkdir(),
    "on-a-hill.npz": swinging_run(terrain="hill.npz"),
    # Other files.
    "map.npz": write_map,
    "way.csv": "time,forward,sideways,yaw_rate\n0,0.5,0,0\n",
    "raising.py": "raise RuntimeError('not today')\n",
    "file": "",
    "robot.urdf": lambda path, make_run: shutil.copy(RobotDescription.load("solo8").urdf.path, path),
}


PARAMS_FILES = {
    "cat.toml": "cat.toml: has parameters of robot 'cat', not of 'minitaur'",
    "range.toml": "motor_strength is 9; minitaur allows 0 to 4",
    "short.toml": "motor_strength has shape (2,); it must fit (1, 8)",
    "step.toml": "control_step is 0.008, and the task's is 0.006",
    "no.toml": "no.toml: can't be read: No such",
}


def reject_params_files(command: str, *needs: str) -> list[RejectedCommand]:
    """Return command lines that are rejected because of an invalid parameter file."""
    return rejected(command, {f"--params {name}": part for name, part in PARAMS_FILES.items()}, *needs)


REJECTED_COMMANDS = [
    *rejected(
        "",
        {
            "fly": "'fly' is not a command; choices: train, adopt, export, ",
            "evalute trot": "'evalute' is not a command; did you mean evaluate? choices: train, adopt",
        },
    ),
    *rejected(
        "train",
        {
            "trot --seed 12345678901234567890123": "seed is 12345678901234567890123; it must be 4294967295 or less",
            "trot --ppo.gamma nan": "ppo.gamma is nan; it must be a finite number",
            "trot --ppo.gamma 2": "ppo.gamma is 2; it must be 1 or less",
            "trot --task.history 1000000000": "history is 1000000000; it must be 100 or less",
            "trot --ppo.policy-hidden": "--ppo.policy-hidden has no value",
            "trot --name ../../x": "name is '../../x'; a name has letters",
            "name.yaml": "name.yaml: name is '../../x'; a name has letters",
            "digits.yaml": "digits.yaml: is not YAML",
            "large.yaml": "fall_angle is 1000000",
            "list.yaml": "list.yaml: train: it is [1]; it must be a table",
            "key.yaml": "observation is not a key; did you mean observations? choices: name, robot",
            "speed.yaml": "speed.yaml: speed is not a key; choices: name, robot",
            "ranges.yaml": "ranges.yaml: randomize.voltage is [16, 15]; the lower bound must come first",
            "long-legs.yaml": "a leg of minitaur allows 0.6 to 2.7",
            "trot --actuator --pushes": "--actuator",
            "trot --servo-latency soon": "--servo-latency",
            "trot --control-latency 0 --set control_latency=0.01": "control_latency is given twice",
            "trot --actuator constraint --task.thermal-protection": (
                "thermal_protection is on; it requires actuator dc"
            ),
            "trot --randomize.control_latency 0.03 0.01": "[0.03, 0.01]; the lower bound must come first",
            "trot --randomize.control-latency 0 15": (
                "[0, 15]; minitaur allows control_latency from 0 to 0.1 (unit: s)"
            ),
            "walk": (
                "task 'walk' does not exist; choices: gallop, gallop-robust, scratch, steer, steer-robust, terrain"
            ),
            "gallop --num-envs few": "few",
            "gallop --nun-envs 8": "nun-envs",
            "gallop --robot spot": "robot 'spot': no such robot",
            "trot --task.feedback.swing -2 2": "swing can be -2.300 to 2.300 rad",
            "gallop --task.observations roll smell": "observation 'smell' does not exist; choices: roll, pitch",
            "trot --task.robot go2": "--task.robot is not an option; did you mean --robot?",
            "trot --task.reward.progres 1": "did you mean --task.reward.progress?",
            "--resume nowhere": "nowhere: is not a run folder",
            "--resume run --params robot.toml": ("--params is not an option; all options: surefoot train --help"),
            "trot --task.reference.foot.height 0.2": (
                "--task.reference.foot.height is an option of references of kind foot, follow, but the task's kind is "
                "sine; to change the kind: --task.reference.kind foot"
            ),
            "trot --task.reference.kind follow": "reference.kind is follow; it needs commands",
            "trot --task.reference.kind square": (
                "reference.kind is 'square'; choices: none, sine, table, foot, follow"
            ),
        },
        "torch",
        "mujoco",
    ),
    *reject_params_files("train trot", "torch", "mujoco"),
    *rejected(
        "adopt theirs.onnx",
        {
            "--from mjlab --robot go2 --out x.pt": "--out is x.pt; the name must end in .onnx",
            "--from mjlab --robot minitaur --out x.onnx": "joints are FL_hip_joint",
            "--from mjlab --robot go2 --out x.onnx --config x.yaml": (
                "--config is given, but mjlab has everything in the network's file"
            ),
            "--from rl_sar --robot go2 --out x.onnx": "config.yaml: can't be read: No such file",
            "--from isaac --robot go2 --out x.onnx": "--from",
            "--from mjlab --robot go2 --out x.onnx --forward 0.2 0.7": (
                "--forward is 0.2 to 0.7; it must go from 0 or less to 0 or more"
            ),
            "--from mjlab --robot go2 --out x.onnx --kp -3": "kp is -3; it must be 0 or more",
        },
        "torch",
        "onnx",
    ),
    *rejected(
        "evaluate",
        {
            "": "neither POLICY nor --trace is given",
            "\udc80": "the arguments contain unprintable characters",
            "nowhere": "policy 'nowhere' does not exist",
            "tort": "policy 'tort' does not exist; did you mean trot? choices: gallop",
            "cut.onnx": "is damaged or not ONNX",
            "early.onnx": "contract.control_latency is -0.02; it must be 0 or more",
            "foot.yaml": "foot.yaml: handcrafted is missing",
            "trot --episodes 0": "episodes is 0; it must be 1 or more",
            "trot --episodes x": "x",
            "trot --push-force 40 20": "pushes.force is [40.0, 20.0]; the lower bound must come first",
            "trot --push-force -1 20": "push_force[0] is -1; it must be 0 or more",
            "trot --set strength=1": (
                "'strength' is not a physical parameter; did you mean motor_strength? choices: base_mass"
            ),
            "trot --set motor_strength=9": "motor_strength is 9; minitaur allows 0 to 4",
            "trot --set motor_strength=much": "sets no number",
            "trot --world moon": "world 'moon' does not exist; choices: mujoco",
            "trot --robot spot": "robot 'spot': no such robot",
            "trot --robot g2": "did you mean go2? choices: go2, minitaur",
            "trot --out /dev/null/out": "/dev/null",
            "trot --trace": "--trace has no value; it takes one or more",
            "trot --params /dev/zero": "/dev/zero: can't be read: not a regular file",
            "trot --actuator servo": "servo",
            "trot --servo-latency -0.001 --out o": "servo_latency is -0.001; minitaur allows",
            "trot --actuator constraint --thermal-protection --out o": "it requires actuator dc",
            "trot --randomize.base_mass_ratio 80 120": "minitaur allows base_mass_ratio from 0.2 to 5",
            "trot --randomize nowhere": "'nowhere' does not exist; choices: ensemble, none, table1, or the path",
            "trot --command-grid": "this policy has no commands to follow",
            "trot --command 0.1 0 0": "this policy has no commands to follow",
            "go2-steer --command 9 0 0": "forward is 9; this policy follows -1.02",
            "go2-steer --command 0.4 0.2 0 --command-grid": (
                "--command and --command-grid are given; give one of them"
            ),
            "go2-steer --commands none.csv": "commands none.csv: can't be read",
            "go2-steer --command-grid --commands way.csv": "--command-grid and --commands are given",
            "go2-steer --terrain stairs:9": "terrain stairs: size is 9 m; it must be 0.01 to 0.4",
            "trot --plugin no.py": "plug-in no.py: can't be read: No such file",
            "trot --plugin no": "plug-in 'no' is neither a file whose name ends in .py",
            # Recorded runs.
            "trot --trace run": "--trace and a policy are given",
            "--trace none": "trace folder none does not exist",
            "--trace run --seed 3": "--trace and --seed are given",
            "--trace run --set voltage=15": "--trace and --set are given",
            "--trace run --randomize table1": "--trace and --randomize are given",
            "--trace run --params robot.toml": "--trace and --params are given",
            "--trace run --control-latency 0": "--trace and --control-latency are given",
            # Several policies.
            "go2-trot go2-steer": "policy 'go2-trot' follows no commands",
            "go2-steer trot": "policies that are compared must be for the same robot",
            "trot gallop": "policy 'trot' follows no commands; policies that are compared must",
            "go2-steer go2-terrain --conditions ice": ("--conditions are ice; choose from nominal, bullet, table1"),
            "go2-steer go2-terrain --conditions feet feet": "--conditions are feet, feet; choose from",
            "go2-steer --conditions rain": "--conditions are rain; choose from nominal, bullet",
            "go2-steer --conditions": "--conditions has no value",
            "go2-steer go2-terrain --terrain stairs:0.1": "--terrain is not an option",
        },
        "mujoco",
        "onnx",
    ),
    *reject_params_files("evaluate trot --out o", "mujoco"),
    *rejected(
        "evaluate sensitivity",
        {
            "": "no policy is given",
            "trot --values 1000000000": "values is 1000000000; it must be 1000 or less",
            "trot --duration 0": "duration is 0; it must be over 0",
            "trot --world moon": "world 'moon' does not exist; choices: mujoco",
            "trot --ranges table9": "'table9' does not exist; did you mean table1? choices: ensemble, none",
            "trot --out /dev/null/out": "/dev/null",
        },
        "mujoco",
        "matplotlib",
    ),
    *reject_params_files("evaluate sensitivity trot", "mujoco", "matplotlib"),
    *rejected(
        "gap",
        {
            "--to mujoco": "no policy is given",
            "gallop": "no --to is given; it takes the name of a world, or trace FOLDER",
            "gallop --to moon": "world 'moon' does not exist; choices: mujoco, bullet",
            "gallop --to trace": "--to is 'trace'; it takes the name of a world, or trace FOLDER",
            "gallop --to mujoco bullet": "--to is 'mujoco bullet'; it takes",
            "gallop --to mujoco --to mujoco": "--to mujoco is given twice",
            "gallop --from moon --to mujoco": "world 'moon' does not exist",
            "gallop --to mujoco --episodes 0": "episodes is 0; it must be 1 or more",
            "gallop --to mujoco --to-set strength=1": "'strength' is not a physical parameter",
            "gallop --to mujoco --from-set motor_strength=9": "motor_strength is 9; minitaur allows 0 to 4",
            "gallop --to mujoco --out /dev/null/gap": "/dev/null",
            "gallop --to trace nowhere": "trace folder nowhere does not exist",
            "gallop --to trace mine --to-set voltage=15": "--to-set is given, but nothing is simulated",
            "gallop --to trace mine --to-actuator constraint": "--to-actuator is given, but nothing",
            "gallop --from trace mine --to mujoco --from-set voltage=15": "--from-set is given, but nothing",
            "gallop --from trace a --to trace b --params robot.toml": ("--params is given, but nothing is simulated"),
            "gallop --to trace mine --out mine/gap": "are inside one another",
            "gallop --to trace .": "are inside one another",
            "gallop --to trace two-worlds": (
                "trace two-worlds: the traces come from more than one world: bullet, lab; measure one at a time"
            ),
            "gallop maxitaur.onnx --to mujoco": "policy 'trot' is for robot 'maxitaur'",
            "odd.onnx --to mujoco": "policy name is 'a/b c'; a name has letters, digits",
            "above.onnx --to mujoco": "policy name is '..'; a name has letters, digits",
            "outside.onnx --to mujoco": "policy name is '../../x'; a name has letters, digits",
            "trot --to-actuator d": "--to-actuator is 'd'; did you mean dc? choices: dc, constraint",
        },
        "mujoco",
        "matplotlib",
        "onnx",
    ),
    *reject_params_files("gap trot --to mujoco", "mujoco", "matplotlib"),
    *rejected(
        "show",
        {
            "": "neither POLICY nor TRACE is given; all options: surefoot show --help",
            "--out x.html": "neither POLICY nor TRACE is given",
            "--world bullet": "neither POLICY nor TRACE is given",
            # A policy.
            "trot --duration 1e30": "duration is 1e+30; it must be 3600 or less",
            "trot --duration 0": "duration is 0",
            "trot --duraton 3": "--duraton is not an option; did you mean --duration?",
            "trot --control-latency 1": "control_latency is 1; minitaur allows 0 to 0.1",
            "trot --world": "--world has no value",
            "trot --out film.gif": "the name must end in .mp4",
            "trot --layout over": ("--layout is not an option for trot, a policy; all options: surefoot show --help"),
            "trot --plugin raising.py": "raising.py, line 1: RuntimeError: not today",
            # Recorded runs.
            "a.npz --html a.html": "--html is not an option; all options: surefoot show --help",
            "a.npz --pushes": "--pushes is not an option for a.npz, a recorded run",
            "none.npz --out x.html": "does not exist",
            "foreign.npz --out x.html": "which is not built in; give its folder with --robot",
            "other-motors.npz --out x.html": "was recorded on robot 'minitaur'",
            "run.npz cut.npz --out x.html": "cut.npz: is cut off, damaged",
            "map.npz --out x.html": "map.npz: not an episode trace",
            "run.npz --out x.txt": "must end in .html",
            "run.npz run.npz --out x.mp4": "2 runs are given; a video shows only one",
            f"{'run.npz ' * 17}--out x.html": "17 traces are given",
            "on-a-hill.npz --terrain map.npz --out x.html": "the traces' terrain is 'hill.npz'",
            "on-a-hill.npz --terrain rough:0.1 --out x.html": "it must be a height map",
        },
        "mujoco",
        "viser",
        "imageio_ffmpeg",
    ),
    *reject_params_files("show trot --out o.mp4", "mujoco", "imageio_ffmpeg"),
    *rejected(
        "emulate",
        {
            "--world gazebo": "world 'gazebo' does not exist; choices: mujoco, bullet",
            "--robot cat": "robot 'cat': no such robot",
            "--hidden-ranges ensemble": "--hidden-ranges is given without --hidden-seed",
            "--fault melt": "'melt' is not a fault; choices: corrupt, drop",
            "--fault drop=0.1 --fault drop": "fault drop is given twice",
            "--fault slow-servo=0.0025": "fault slow-servo is 0.0025; it must be a multiple of the servo step, 0.001 s",
            "--fault remote-stop": (
                "fault remote-stop acts on the remote control, which --link serial does not have; give --link dds"
            ),
            "--lockstep --fault overload": ("fault overload", "with --lockstep"),
            "--rack --fault tilt": "it can't be combined with --rack",
            "--terrain stairs:9": "terrain stairs: size is 9 m; it must be 0.01 to 0.4",
            "--link dds": "link dds requires the network interface of the topics; give --interface, such as lo",
            "--link tcp": "dds",
            "--interface lo": "motion_service apply to a DDS link; give --link dds as well",
            DDS: "link dds is for a Unitree Go2; robot minitaur has other motors, give --robot go2",
            f"{DDS} --domain 233": "domain is 233; it must be 232 or less",
            f"{DDS} --lockstep": "lockstep applies to the serial link; it can't be combined with --link dds",
            f"{DDS} --fault garbage": (
                "fault garbage acts on bytes between messages, which --link dds does not have; give --link serial"
            ),
            "--duration 0": "duration is 0; it must be over 0",
            "--duration 1e30": "duration is 1e+30; it must be 10000000 or less",
            "--baud -1": "baud is -1; it must be 0 or more",
            "--baud 300": "baud is 300; it must be 9600 or more, or 0",
            "--hidden-seed -1": "hidden_seed is -1; it must be 0 or more",
            "--hidden-seed 1 --set voltage=15": "can't be combined with --params or --set",
            "--hidden-seed 1 --out way.csv": "exists; give another name",
            "--hidden-seed 1 --out cat.toml": "exists; give another name",
            "--hidden-seed 1 --symlink file": "exists; give another name",
            "--out x.toml": "out x.toml is for hidden parameters; give --hidden-seed as well",
            "--out x.txt": "out x.txt: the name must end in .csv or .toml, with one file of each",
            "--out x.csv y.csv": "out y.csv: the name must end in",
            "--set voltage=99": "voltage is 99; minitaur allows 5 to 30",
            "--params missing.toml": "missing.toml: can't be read: No such file",
            "--viewer": "viewer: there is no display (DISPLAY",
        },
        "mujoco",
    ),
    *rejected(
        "deploy",
        {
            "trot": "--port",
            "trot --port /dev/nothing": "port /dev/nothing: can't be opened: No such file or directory",
            "canter --port x": "policy 'canter' does not exist",
            "trot --port x --duration -1": "duration is -1; it must be over 0",
            "trot --port x --episodes 0": "episodes is 0; it must be 1 or more",
            "trot --port x --out /dev/null": "out is /dev/null; it must be a folder",
            "trot --port x --height-map 5556": "--height-map is given; policy 'trot' uses no height map",
            "go2-steer --link dds": "--interface is missing; it names the network interface",
            "go2-steer --link can": "--link is 'can'",
            "go2-steer --port x --release": "--release is given; it requires --link dds",
            "go2-steer --port x --interface lo": "--interface is given; it requires --link dds",
            f"go2-steer {DDS} --dry-run --release": "--dry-run and --release can't be combined:",
            f"go2-steer {DDS} --dry-run --hand-back": "--dry-run and --hand-back can't be combined: a dry run sends",
            "go2-steer --port /dev/nothing --commands keyboard": "commands: keyboard needs a terminal",
        },
    ),
    *rejected(
        "deploy",
        {
            "nan.onnx --port x": "contract: is not JSON: it holds NaN",
            "tilting.onnx --port x": "fall_angle is 1e+09; it must be",
            "stale.onnx --port x": ("stale.onnx: its digest does not match: the network or the contract was changed"),
            "columns.onnx --port x": (
                "policy 'gallop' must not run on minitaur: ",
                "column 4 is 'angle.front_left_1_motor' (policy)",
            ),
            "wide.onnx --port x": ("policy 'trot' must not run on minitaur: ", "swing can be -1.100 to 0.550 rad"),
        },
        "onnx",
    ),
    *rejected(
        "deploy",
        {
            "go2-steer --link dds --interface eth9": "there is no network interface 'eth9'; it must be one of",
            f"go2-steer {DDS} --port x": "--port and --link dds can't be combined",
            f"go2-steer {DDS} --lockstep": "--lockstep and --link dds can't be combined",
            f"go2-steer {DDS} --domain 231": "domain is 231; it must be",
            f"trot {DDS}": "a DDS link needs a Unitree Go2; minitaur must have",
        },
        "cyclonedds",
    ),
    *rejected(
        "doctor",
        {
            "trot": "--port",
            "go2-steer": "--port is missing",
            "none.onnx --port /dev/none": "policy 'none.onnx' does not exist",
            "trot --port /dev/none --json": "port /dev/none: can't be opened: No such file or directory",
            "trot --port x --world bullet": "--world is given; it is for the simulation of an adopted policy",
            "trot --port x --seed 3": "--seed is given; it is for the simulation of an adopted policy",
            "trot --port x --rack --ground": "--rack and --ground can't be combined",
            "trot --port x --pings 1": "pings is 1; it must be 10 or more",
            "trot --port x --steps 0": "steps is 0; it must be 10 or more",
            "trot --port x --robot cat": "robot 'cat': no such robot",
        },
    ),
    *rejected(
        "doctor",
        {
            "unnormalized.onnx --port x": (
                "unnormalized.onnx: its digest does not match: the network or the contract was changed"
            ),
            "columns.onnx --port x": (
                "policy 'gallop' must not run on minitaur: ",
                "column 4 is 'angle.front_left_1_motor' (policy)",
            ),
            "wide.onnx --port x": ("policy 'trot' must not run on minitaur: ", "swing can be -1.100 to 0.550 rad"),
        },
        "onnx",
    ),
    *rejected(
        "identify",
        {
            "tail": (
                "'tail' is not an experiment; choices: motor, latency, mass, contact, air, replay, import, "
                "motor-figure, or --trace FOLDER"
            ),
            "imprt": "'imprt' is not an experiment; did you mean import?",
            "motor": "--recording of an experiment; neither is given",
            "motor --port x --recording y": "--recording of an experiment; both are given",
            "motor --recording x --yes": "--yes is given; it can't be combined with --recording",
            "motor --recording x --record-only": "--record-only is given; it can't be combined with --recording",
            "motor --recording x --set foo=1": "--set is given; it can't be combined with --recording",
            "motor --recording x --lockstep": "--lockstep is given; it can't be combined with --recording",
            "motor --port x --domain 3": "--domain is given; it requires --link dds",
            "--trace none --plan": "--plan is for logs of a robot with joint actuators",
            "--trace none --duration 3": "--duration is for logs of a robot with joint actuators",
            "motor --port x --record-only --params a.toml": "--record-only and --params can't be combined",
            "motor --port x --params a.txt": "params a.txt: the name must end in .toml",
            "motor --recording none": "recording none: can't be read: No such file",
            "motor --port /dev/none --yes": "/dev/none",
            "motor --port /dev/none --robot cat": "robot 'cat': no such robot",
            "motor --port /dev/none": "motors will move and the robot must hang freely, with its legs in the air; ",
            "mass --port /dev/none --record-only": "the robot must sit on flat ground with a metre of free space",
            "--trace none": "trace folder none does not exist",
            "--trace=none": "trace folder none does not exist",
            "--trace no-logs --robot pupper_v2": "folder no-logs contains no logs (.npz)",
            "motor-figure --motor tail": "motor 'tail' does not exist",
            "motor-figure --out motor.pdf": ("out motor.pdf: the name must end in .png or .csv, with one file of each"),
            "motor-figure --frequency 0": "frequency is 0; it must be over 0",
            "motor-figure --log none.csv": "none.csv: can't be read",
            "motor-figure --set mass=2": "'mass' is not a physical parameter",
            "motor-figure --world moon": "world 'moon' does not exist",
        },
    ),
    *rejected(
        "identify replay --robot pupper_v2",
        {
            "pupper.npz --params nothing": ("params is 'nothing'; it must be a file (.toml), or a name; choices: id"),
            "pupper.npz --world newton": "world 'newton' does not exist; choices: mujoco, bullet",
            "pupper.npz --out figure.svg": "out figure.svg: the name must end in .png",
            "pupper.npz --set mass=1": "'mass' is not a physical parameter",
            "short.npz": "short.npz is 0.04 s long; errors are evaluated after 0.3 s",
        },
        "mujoco",
    ),
    *rejected(
        "robot",
        {
            "make": "'make' is not an action; choices: new, check",
            "chek go2": "'chek' is not an action; did you mean check? choices: new, check, firmware",
            "new": "FILE",
            "new none.urdf": "none.urdf: can't be read",
            "new robot.urdf --forward up": "forward",
            "new robot.urdf --name a/b": "name is 'a/b'",
            "check none": "robot 'none': no such robot",
            "firmware old": "'old' is not an action",
            "firmware new no-such-robot": "no-such-robot",
            "firmware motor x --yes --port /dev/null": "'x' is no motor of minitaur",
            "firmware motor front_left_1_motor --port /dev/null": "confirm it with --yes",
        },
    ),
    *rejected(
        "study",
        {
            "serach trot": (
                "'serach' is neither a study file (.yaml) nor an action; did you mean search? choices: run, "
                "identify, search"
            ),
            "study-name.yaml": "name is '../../x'; a name has letters",
            "study.yaml --workers -1": "workers is -1; it must be 0",
            "study.yaml --only fast": "group 'fast' is not in the study; choices: plain, drawn",
            "study.yaml --seeds 1 1": "seeds is [1, 1]; it needs 1 or more, all different",
            "study.yaml --train-only --report-only": "--train-only and --report-only can't be combined",
            "study.yaml --report-only": "runs/tiny: no run of the study is finished and evaluated",
            "study.yaml --ray nowhere": "ray is 'nowhere'; it must be HOST:PORT",
            "none.yaml": "none.yaml: can't be read",
            "study-kind.yaml": "evaluate: 'luck' is no kind of evaluation; choices: nominal, table1, sensitivity, gap",
            "study-primary.yaml": (
                "primary: 'gap' is not a metric of its evaluations; choices: nominal_speed, nominal_return"
            ),
            "study-gaps.yaml": "evaluate: a study measures one reality gap; it has gap, gap_test",
            "study-bars.yaml": "bars: they show the reality gap, so evaluate must contain 'gap'",
            "study-robot.yaml": "group a: observation 'smell' does not exist",
            "--report-only": "FILE is missing",
            "run": "FILE is missing",
            "run study-kind.yaml": "evaluate: 'luck' is no kind of evaluation",
        },
        "torch",
        "matplotlib",
    ),
    *rejected(
        "study search",
        {
            "": "TASK",
            "gallopp": "gallopp",
            "trot --trials 0": "trials is 0; it must be 1 or more",
            "trot --space none.yaml": "none.yaml: can't be read",
            "trot --space space-key.yaml": "space-key.yaml: ppo.leg is not a key; choices: policy_hidden",
            "trot --space space-reversed.yaml": (
                "space-reversed.yaml: ppo.gamma: low is 0.9 and high is 0.8; low must be below"
            ),
            "trot --space space-robot.yaml": ("space", "robot"),
            "trot --resume": "searches/trot: has no search to resume; leave --resume out to begin one",
            "trot --out file": "out is file; it must be a folder",
            "trot --ray nowhere": "ray is 'nowhere'; it must be HOST:PORT",
        },
        "optuna",
        "ray",
        "torch",
    ),
    *rejected(
        "study tune",
        {
            "--speed 0": ("speed is 0", "0.05 or more"),
            "--gait waltz": ("--gait", "trot"),
            "--out gait.txt": "gait gait.txt: the name must end in .yaml",
            "--start-from nothing.yaml": "nothing.yaml: can't be read",
            "--start-from foot.yaml": "foot.yaml: handcrafted is missing",
            "--start-from hand.yaml": "hand.yaml: handcrafted.about.parameters is missing",
            "--start-from deep.yaml": "parameter depth of the gait to start from is 'deep'; it must be a number",
            "--robot nobody": "robot 'nobody': no such robot",
        },
        "cma",
        "mujoco",
    ),
    *rejected(
        "study paper",
        {
            "--root .": ("root is .", "with tools/paper_runs.py"),
            "--out page.pdf": "out page.pdf: the name must end in .html",
            "--root REPOSITORY --quick --full": "--quick and --full are given; give one of them",
            "--root REPOSITORY --workers 2": ("--workers", "require --quick or --full"),
            "--root REPOSITORY --quick --out file": "file; it must be a folder",
        },
        "mujoco",
        "matplotlib",
    ),
    # Missing packages.
    *rejected(
        "",
        {
            "gap gallop --to bullet": "bullet",
            "gap gallop --from bullet --to mujoco": "bullet",
            "evaluate gallop --world bullet --out out": "bullet",
            "evaluate sensitivity gallop --world bullet": "bullet",
            "show gallop --world bullet": "bullet",
            "emulate --world bullet": "bullet",
        },
        "mujoco",
        "matplotlib",
        "imageio_ffmpeg",
        hidden="pybullet",
    ),
    *rejected("evaluate trot", {"--out out": "report"}, "mujoco", hidden="matplotlib"),
    *rejected("show trot", {"--out x.mp4": "report"}, "mujoco", hidden="imageio_ffmpeg"),
]
