"""The two sides of a gap, from words of the command line: worlds to run policies in, and folders of recorded traces."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from surefoot.errors import SurefootError

if TYPE_CHECKING:
    from surefoot.task.trace import EpisodeTrace

TRACE = "trace"
_SAME = 0.01
"""Share of a length by which lengths may differ: whole control steps rarely make it exactly."""


@dataclass(frozen=True)
class Side:
    """Where runs come from: a simulated world, or traces in a folder."""

    world: str = ""
    """Name of the world; empty for traces."""
    folder: Path | None = None
    """Folder of traces; None for a world."""

    @classmethod
    def of_words(cls, option: str, words: Sequence[str]) -> Side:
        """Read the words behind `--from` or `--to`.

        Raises:
            SurefootError: neither one world nor `trace FOLDER`.
        """
        if len(words) == 2 and words[0] == TRACE:
            return cls(folder=Path(words[1]))
        if len(words) == 1 and words[0] != TRACE:
            return cls(world=words[0])
        said = " ".join(words) or "nothing"
        raise SurefootError(f"{option} is '{said}'; it takes the name of a world, or {TRACE} FOLDER")

    def __str__(self) -> str:
        return self.world or f"{TRACE} {self.folder}"


def check_heeded(option: str, sides: Sequence[Side]) -> None:
    """Refuse an option for simulated worlds where there is none.

    Raises:
        SurefootError: all sides are traces.
    """
    if not any(side.world for side in sides):
        raise SurefootError(f"{option} is given, but nothing is simulated on its side: {sides[0]}")


def check_sides(out: Path, home: Side, away: Sequence[Side]) -> None:
    """Refuse a side given twice, and runs that would be written where traces are read.

    Raises:
        SurefootError: one of these.
    """
    if not away:
        raise SurefootError(f"no --to is given; it takes the name of a world, or {TRACE} FOLDER")
    for side in away:
        if list(away).count(side) > 1:
            raise SurefootError(f"--to {side} is given twice; give each once")
    for side in (home, *away):
        if side.folder is not None:
            whole, part = out.resolve(), side.folder.resolve()
            if whole == part or whole in part.parents or part in whole.parents:
                raise SurefootError(
                    f"--out {out} and the traces of {side.folder} lie one in the other; give --out a folder of its own"
                )


def check_lengths(found: Sequence[tuple[Path, EpisodeTrace]], duration: float) -> None:
    """Refuse traces of runs that were to last longer or shorter than those that they are compared with.

    Args:
        found: traces with their files.
        duration: length of a run [s].

    Raises:
        SurefootError: one whose return is of another length of time.
    """
    for path, trace in found:
        length = trace.meta["max_steps"] * trace.meta["control_step"]
        if abs(length - duration) > _SAME * duration:
            raise SurefootError(
                f"trace file {path}: its run was to last {length:.3g} s, the others last {duration:.3g} s; "
                f"give --duration {length:.3g} to compare with runs as long"
            )


def labels(worlds: Sequence[str], sides: Sequence[Side]) -> list[str]:
    """Names that tell sides apart, home first: a world that comes twice is marked.

    Args:
        worlds: name of each side's world.
        sides: where its runs come from.
    """
    taken: list[str] = []
    for world, side in zip(worlds, sides, strict=True):
        stem = world
        if world in taken:
            stem = f"{world}-away" if side.folder is None else f"{world}-{side.folder.resolve().name}"
        name, number = stem, 2
        while name in taken:
            name, number = f"{stem}-{number}", number + 1
        taken.append(name)
    return taken
