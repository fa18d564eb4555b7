"""Tests of the C firmware, compiled for this computer with address and undefined-behaviour sanitizers.

    python benchmarks/firmware.py fuzz [--frames 1000000]       # results/firmware/fuzz.json
    python benchmarks/firmware.py faults                        # results/firmware/faults.csv
    python benchmarks/firmware.py runs [--runs 10]              # results/firmware/runs.csv
    python benchmarks/firmware.py live [--runs 10]              # results/firmware/live.csv
    python benchmarks/firmware.py stm32f4                       # results/firmware/stm32f4.json

`fuzz`: frames with random fields, in any order and from several operators, reach the firmware over a bad line
(`link_soak.py`). Failures are a memory error, undefined behaviour, a wait of over 5 s, a count of frames that differs
from the Python decoder's, or a motor command above its limit; the exit code is then 1.

`faults`: `surefoot deploy` in lockstep on the firmware. Each fault begins while the robot stands up, while the policy
runs, and while it sits down. A row has the time for which motors are still driven after the fault [ms] in each phase,
the maximum time after the last accepted command, and the number of the three runs that left the robot armed.

`runs`: `surefoot deploy trot-robust` in lockstep for 10 s, on robots with different noise, with the Python board, with
the firmware, and with the firmware on an STM32F405 in QEMU.

`live`: the same in real time over a socket. One row per run: how it ended, missed control steps, the maximum age of a
state, how often the emulated robot was more than 10 ms behind real time, and the gaps of an idle loop that ran at the
same time. `interrupted` is 1 if one of these gaps was over 12 ms (two control steps), caused by the computer.

`stm32f4`: bytes of flash and RAM of the STM32F405's firmware, which is linked into 32 and 8 KiB, and instructions that
QEMU counts (`-icount shift=0`) in a servo step and for messages.
"""

from __future__ import annotations

import argparse
import itertools
import json
import random
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from bare_loop import BareLoop
from emulated import deploy
from link_soak import BadLine

from surefoot.deploy import messages
from surefoot.deploy.board.signals import Sensors
from surefoot.deploy.messages import Message
from surefoot.deploy.serial.codec import Codec
from surefoot.deploy.serial.frames import Decoder, encode_frame
from surefoot.emulator.firmware_process import FirmwareProcess
from surefoot.evaluation.runs import measure_runs
from surefoot.firmware.project import build_firmware, write_sources
from surefoot.robot import RobotDescription
from surefoot.studies.robot_identification import SUREFOOT_COMMAND
from surefoot.tables import write_csv

TESTS = Path(__file__).resolve().parents[1] / "tests"
RESULTS = Path("results/firmware")
SANITIZE = "OPTIMIZE=-O1 -fsanitize=address,undefined -fno-sanitize-recover=all"
BLOCK = 4
"""Frames between two servo steps."""
ROBOT = RobotDescription.load("minitaur")
CODEC = Codec(ROBOT.num_motors)
PHASES = {"rise": 0.6, "run": 1.4, "sit": 1.65}
"""When a fault begins [s after arming]; the policy runs from 1.1 to 1.5 s."""
MAX_BARE_GAP = 12.0
"""Gap of an idle loop [ms] above which the computer has interrupted a run."""
FAULTS = (
    *("unplug={}", "drop=1@{}", "corrupt=1@{}", "cut-frames=1@{}", "stale-state={}", "repeat-sequence={}"),
    *("backward-sequence={}", "reboot={}", "hang=0.2@{}", "tilt={}", "battery-low=11@{}", "motor-hot=95@{}"),
)


def random_message(rng: random.Random, operator: int) -> Message:
    """Return a message with random fields, mostly from the given operator."""
    session = rng.choices((operator, 8, 0, rng.randrange(65536)), (30, 1, 1, 1))[0]
    special = (np.nan, np.inf, -np.inf, 1e30, 0.0, 4.7)
    values = np.full(8, 1.5) if rng.random() < 0.998 else np.array([rng.choice(special) for _ in range(8)])
    seconds = rng.choice((0.0, 0.006, 0.006, 0.006, 0.05, 4000.0))
    mode = rng.choice((1, 1, 1, 2, rng.randrange(256)))
    kinds: list[tuple[int, Message]] = [
        (100, messages.Position(session, values)),
        (10, messages.Pwm(session, values / 8)),
        (30, messages.Ping(rng.randrange(2**32))),
        (3, messages.Hello(session, seconds)),
        (20, messages.Arm(session, mode, seconds, rng.choice((0.0, 0.003, seconds)))),
        (1, messages.Damp(session)),
        (1, messages.Disarm(session)),
        (1, messages.Bye(session)),
        (1, messages.Pong(3)),
        (1, messages.Fault(session, rng.randrange(256), "x" * rng.randrange(81))),
    ]
    return rng.choices([message for _, message in kinds], [weight for weight, _ in kinds])[0]


def fuzz(frames: int, seed: int, program: Path) -> dict[str, Any]:
    """Send frames to the firmware; return the counts."""
    rng, start = random.Random(seed), time.perf_counter()
    firmware, line = FirmwareProcess(program, ROBOT.name, 8), BadLine(rng)
    decoder = Decoder(Codec(8, text_errors="replace"))
    now = number = sent = step = me = 0
    modes: Counter[str] = Counter()
    reasons: Counter[str] = Counter()
    wrong = 0
    while sent < frames:
        # Rounds of 240 steps: silence, after which any operator may connect; a clean link that arms; then anything.
        step, turn = step + 1, step % 240
        clean = turn < 40
        if turn == 0:
            now, number, me = now + 1_200_000, 0, rng.randrange(9, 65536)
        batch = []
        for _ in range(1 if clean else BLOCK):
            number = number + 1 if clean or rng.random() < 0.98 else rng.randrange(1, number + 2)
            moment = now / 1e6 if rng.random() < 0.99998 else rng.uniform(0, 2e13)
            message = random_message(rng, me)
            if clean:
                message = messages.Ping(step) if turn > 2 else messages.Hello(me, 0.01)
                message = messages.Arm(me, rng.choice((1, 1, 2)), 0.006, 0.003) if turn > 37 else message
            batch.append(encode_frame(CODEC, message, number, moment))
        sent += len(batch)
        data = b"".join(batch) if clean else line.carry(batch)[0]
        decoder.feed(data)
        firmware.receive(now, data)
        normal = clean or rng.random() < 0.998
        numbers = np.full(8, 1.5), np.zeros(8), np.zeros(8), np.zeros(3), np.zeros(3), 0.0, 16.0, np.full(8, 30.0)
        odd = np.array([rng.choice((0.0, np.nan, np.inf, -1e30)) for _ in range(8)])
        seen = Sensors(*numbers) if normal else Sensors(odd, odd, odd, odd[:3], odd[:3], 0.0, float(odd[0]), odd)
        effort = firmware.tick(now, seen)
        wrong += not (np.abs(effort) <= 1.0).all()
        firmware.report(now + 500, lambda seen=seen: seen)  # type: ignore[misc]
        modes[firmware.mode.name] += 1
        for packet in firmware.take():
            if isinstance(packet.message, messages.Fault):
                reasons[messages.Reason(packet.message.reason).name] += 1
        now += 15_000 if clean else rng.choices((1000, 6000, 60_000), (30, 30, 1))[0]
    counted, expected = firmware.statistics, decoder.statistics
    for name in ("received", "damaged", "foreign", "unknown"):
        wrong += getattr(counted, name) != getattr(expected, name)
    return {
        **{"frames": sent, "received": counted.received, "damaged": counted.damaged, "foreign": counted.foreign},
        **{"unknown": counted.unknown, "wrong": wrong, "fates": dict(line.fates), "servo_steps": dict(modes)},
        **{"faults": dict(reasons), "seconds": round(time.perf_counter() - start, 1)},
    }


def run_fault(word: str, phase: str, program: Path) -> tuple[float, float, bool]:
    """Deploy a policy with a fault.

    Returns:
        Times [ms] for which motors were driven after the fault's beginning, and after the last accepted command;
        whether the robot was armed at the end.
    """
    bench = import_module("fault_bench")
    begins, accepted, driven, armed = np.inf, 0.0, 0.0, True

    def observe(board: Any) -> None:
        def look(now: int) -> None:
            nonlocal begins, accepted, driven, armed
            firmware, injector = board.firmware, board.injector
            armed = firmware.armed
            if armed and injector.armed_at is not None:
                begins = injector.armed_at / 1e6 + PHASES[phase]
                accepted, driven = max(accepted, firmware.command_time / 1e6), now / 1e6

        board.on_step.append(look)

    with tempfile.TemporaryDirectory() as folder:
        scenario = bench.Scenario((word.format(PHASES[phase]),), duration=0.4)
        bench.play(scenario, Path(folder) / "run", Path(folder), ("--firmware", str(program)), observe)
    return 1e3 * max(driven - begins, 0.0), 1e3 * (driven - accepted), armed


def run_faults(program: Path) -> list[dict[str, Any]]:
    """Return one row per fault: times until the motors are damped [ms], and how many runs left the robot armed."""
    rows = []
    for word in FAULTS:
        results = {phase: run_fault(word, phase, program) for phase in PHASES}
        row: dict[str, Any] = {"fault": word.partition("=")[0]}
        row |= {phase: round(after, 1) for phase, (after, _, _) in results.items()}
        row["after_command"] = round(max(late for _, late, _ in results.values()), 1)
        row["armed"] = sum(armed for _, _, armed in results.values())
        print(row, flush=True)
        rows.append(row)
    return rows


def measure_stm32f4(folder: Path) -> dict[str, Any]:
    """Return the firmware's size and its instruction counts."""
    elf, qemu = (build_firmware(folder, target=target) for target in ("board.elf", "board-qemu"))
    size = subprocess.run(["arm-none-eabi-size", elf], capture_output=True, text=True, check=True).stdout
    text, data, bss = map(int, size.splitlines()[1].split()[:3])
    counting = folder / "board-counting"
    counting.write_text(qemu.read_text().replace("-nographic", "-nographic -icount shift=0"))
    counting.chmod(0o755)
    firmware, number, zeros = FirmwareProcess(counting, ROBOT.name, 8), 0, np.zeros(8)
    seen = Sensors(zeros + 0.3, zeros + 0.1, zeros, zeros[:3], zeros[:3], 0.0, 16.0, zeros + 25)
    counts: dict[str, list[int]] = {}

    def send(message: Message, now: int) -> None:
        nonlocal number
        number += 1
        firmware.receive(now, encode_frame(CODEC, message, number, now / 1e6))
        note(type(message).__name__.lower())

    def note(what: str) -> None:
        # The timer counts 168 per microsecond of emulated time; an instruction takes one nanosecond.
        counts.setdefault(what, []).append(round(firmware.cycles / 0.168))

    send(messages.Hello(7, 0.01), 0)
    send(messages.Arm(7, 1, 0.006, 0.003), 0)
    for now in range(1000, 300_000, 1000):
        if now % 6000 == 0:
            send(messages.Position(7, zeros + 1.5), now)
        firmware.tick(now, seen)
        note("step")
        if now >= firmware.next_state:
            firmware.report(now, lambda: seen)
            note("state")
    instructions = {what: max(values) for what, values in counts.items()}
    return {"flash": text + data, "ram_without_stack": data + bss, **instructions}


def run_policies(runs: int, folder: Path) -> list[dict[str, Any]]:
    """Deploy a policy on all board programs; return one row per program."""
    programs: dict[str, tuple[object, ...]] = {"Python": ()}
    for name, target in (("C", "board"), ("QEMU", "board-qemu")):
        programs[name] = ("--firmware", build_firmware(folder, target=target))
    rows = []
    for name, options in programs.items():
        traces = [
            trace
            for seed in range(1, runs + 1)
            for trace in deploy("trot-robust", "--duration", 10, robot=("--seed", seed, *options))
        ]
        table = measure_runs(traces, "mujoco")
        rows.append(
            {
                **{"program": name, "runs": len(traces), "falls": int(table.fell.sum())},
                "to_the_end": sum(trace.meta["ended"] == "time" for trace in traces),
                **{"distance": table.distance.mean(), "distance_low": table.distance.min()},
                **{"distance_high": table.distance.max(), "power": table.power.mean()},
            }
        )
        print(rows[-1], flush=True)
    return rows


def run_live(runs: int, folder: Path) -> Iterator[dict[str, Any]]:
    """Deploy a policy in real time on all board programs in turn; yield one row per run."""
    programs: dict[str, list[object]] = {"Python": []}
    for name, target in (("C", "board"), ("QEMU", "board-qemu")):
        programs[name] = ["--firmware", build_firmware(folder, target=target)]
    for number, (name, options) in itertools.product(range(1, runs + 1), programs.items()):
        robot = [*SUREFOOT_COMMAND, "emulate", "--socket", folder / "line", *options]
        host = [*SUREFOOT_COMMAND, "deploy", "trot-robust", "--port", folder / "line", "--duration", 10, "--json"]
        with subprocess.Popen(
            list(map(str, robot)), stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        ) as process:
            assert process.stdout is not None
            process.stdout.readline()
            words = list(map(str, [*host, "--out", folder / "live"]))
            bare = BareLoop()
            done = subprocess.run(words, capture_output=True, text=True, check=False)
            bare_metrics = bare.end()
            process.terminate()
            _, summary = process.communicate()
        result: dict[str, Any] = {"ended": "refused", "what": done.stderr.strip().rpartition("\n")[2]}
        if done.stdout:
            (result,) = json.loads(done.stdout)["runs"]
        timing = result.get("timing", {})
        yield {
            **{"program": name, "number": number, "ended": result["ended"], "what": result.get("what", "")},
            **{"missed": timing.get("missed"), "age_ms": timing.get("state_age_max_ms")},
            "behind": int(summary.partition("; behind ")[2].split()[0]),
            **bare_metrics,
            "interrupted": bare_metrics["bare_max_ms"] > MAX_BARE_GAP,
        }


def main() -> int:
    """Measure, and write the results."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=["fuzz", "faults", "runs", "live", "stm32f4"])
    parser.add_argument("--frames", type=int, default=1_000_000)
    parser.add_argument("--runs", type=int, default=10)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--out", type=Path, default=RESULTS, help="folder of the results")
    options = parser.parse_args()
    sys.path.insert(0, str(TESTS))
    with tempfile.TemporaryDirectory() as name:
        folder, results = Path(name), options.out
        write_sources(folder, ROBOT)
        if options.what == "runs":
            write_csv(results / "runs.csv", run_policies(options.runs, folder))
            return 0
        if options.what == "live":
            rows = []
            for row in run_live(options.runs, folder):
                print(row, flush=True)
                rows.append(row)
                write_csv(results / "live.csv", rows)
            return 0
        if options.what == "stm32f4":
            return write_json(results / "stm32f4.json", measure_stm32f4(folder))
        program = build_firmware(folder, SANITIZE)
        if options.what == "fuzz":
            return write_json(results / "fuzz.json", fuzz(options.frames, options.seed, program))
        write_csv(results / "faults.csv", run_faults(program))
    return 0


def write_json(path: Path, result: dict[str, Any]) -> int:
    """Print and write a result; return the exit code."""
    print(text := json.dumps(result, indent=1))
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text + "\n", encoding="utf-8")
    return int(result.get("wrong", 0) > 0)


if __name__ == "__main__":
    raise SystemExit(main())
