"""What a study's report tells of the reality gap: a section for each set of groups, in sentences made of numbers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from surefoot.evaluate.comparison import Comparison, GroupResult
from surefoot.evaluate.ensemble import ROBOTS
from surefoot.evaluate.gap import Estimate, plus_minus
from surefoot.evaluate.gap_groups import FAR, GapDifference, GroupGap, gap_difference, gap_groups
from surefoot.evaluate.kinds import KINDS
from surefoot.evaluate.statistics import CONFIDENCE, Interval, plain
from surefoot.report.gap_bars import gap_bars
from surefoot.report.markdown import table

GAP_FILES = {
    "gap_groups.csv": "one line a group: its runs at home and away, of the top policies and of all",
    "gap_differences.csv": "one line a pair of groups: the difference of their gaps, of the top policies and of all",
    "gap_runs.csv": "one line a run at home or away",
}
_NUMBERS = ("no", "one", "two", "three", "four", "five", "six", "seven", "eight", "nine", "ten", "eleven", "twelve")


@dataclass(frozen=True)
class _Section:
    """Groups that stand side by side."""

    name: str
    """Name of the set."""
    top: tuple[GroupGap, ...]
    """Their best policies."""
    every: tuple[GroupGap, ...]
    """All of their policies."""

    asked: tuple[str, ...]
    """Names of all groups of the set, those without policies too."""

    @property
    def names(self) -> set[str]:
        """Names of the groups."""
        return {group.name for group in self.top}

    @property
    def whole(self) -> bool:
        """Whether the best policies are all there are."""
        return all(len(a.policies) == len(b.policies) for a, b in zip(self.top, self.every, strict=True))


def draw_gaps(comparison: Comparison, folder: Path) -> None:
    """Draw gap_SET.png for each set of groups into a folder."""
    for section in _sections(comparison):
        title = f"{_title(section.name)}: return of the top {_count(comparison.top)} policies of each group"
        gap_bars(section.top, folder / _file(section), title)


def gap_text(comparison: Comparison) -> list[str]:
    """The paragraphs on the reality gap.

    Args:
        comparison: the groups, evaluated with the kind "gap".
    """
    sections = _sections(comparison)
    parts = ["## The reality gap", *_meaning(comparison, sections)]
    told = []
    for section in sections:
        pairs = [pair for pair in comparison.present_pairs() if {pair[0].name, pair[1].name} <= section.names]
        told += pairs
        parts += [f"### {_title(section.name)}", f"![{_title(section.name)}]({_file(section)})"]
        parts += _paper(comparison.finding(section.asked))
        parts += [_top_head(comparison, section), _group_table(section.top)]
        parts += [
            *_weak(section.top),
        ]
        if not section.whole:
            parts += ["The same of all policies of the groups:", _group_table(section.every)]
        parts += _changes(comparison, pairs)
    rest = [pair for pair in comparison.present_pairs() if pair not in told]
    return [*parts, *(["### Other differences", *_changes(comparison, rest)] if rest else [])]


def _sections(comparison: Comparison) -> list[_Section]:
    top, every = gap_groups(comparison, comparison.top), gap_groups(comparison)
    return [
        _Section(
            name,
            tuple(top[group.name] for group in groups),
            tuple(every[group.name] for group in groups),
            comparison.bars.get(name, tuple(group.name for group in groups)),
        )
        for name, groups in comparison.sets()
    ]


def _meaning(comparison: Comparison, sections: Sequence[_Section]) -> list[str]:
    settings, nominal = KINDS["gap"].settings, KINDS["nominal"].settings
    home, away = settings["home"], settings["away"]
    few = sorted({len(group.policies) for section in sections for group in section.top})
    parts = [
        f"At home is the simulator that a policy was trained in: {_engine(home)} with the motors and delays of its own "
        f"task. Away is {_engine(away)}. Between the two stands the robot as its data sheet describes it, in "
        f"{_engine(home)}: what is lost from home to there is the motors' and delays' doing. A gap is the mean return "
        "at home less the mean return away: above zero where a policy does worse than its own simulator says. Nothing "
        "is pushed.",
        f"As in the paper (Tan et al. 2018, section VI-B), the top {_count(comparison.top)} policies of each group are "
        f"taken, those with the highest return in their own simulator, and each is run {_count(settings['episodes'])} "
        f"times in each world. They are chosen by {nominal['episodes']} other episodes, so that the runs at home owe "
        "nothing to the choice. Numbers with ± are means over all these runs with one standard error. Runs of one "
        "policy are not independent of each other, nor are those on one robot, so that this error is the paper's, but "
        "tells little of other policies and robots; numbers with brackets have an interval of "
        f"{CONFIDENCE:.0%} confidence over policies and robots, both taken as drawn by chance.",
    ]
    if few[0] < comparison.top:
        parts.append(f"**Some groups have fewer than {_count(comparison.top)} evaluated policies yet.**")
    return parts


def _top_head(comparison: Comparison, section: _Section) -> str:
    counts = sorted({len(group.away) for group in section.top})
    runs = _count(counts[0]) if len(counts) == 1 else f"{_count(counts[0])} to {_count(counts[-1])}"
    return f"The top {_count(comparison.top)} policies of each group, together {runs} runs of a group in each world:"


def _group_table(groups: Sequence[GroupGap]) -> str:
    header = ["group", "seeds", "return at home (m)", "as described (m)", "return away (m)"]
    header += ["gap (m)", "gap, over policies and robots (m)"]
    header += ["speed at home, away (m/s)", "distance away, least (m)", "power away (W)"]
    header += ["balanced at home, as described, away", f"over {FAR:g} m away"]
    lines = []
    for group in groups:
        home, away = group.home, group.away
        line = [group.label, ", ".join(map(str, group.seeds))]
        line += [plus_minus(runs.estimate("returns")) for runs in (home, group.described, away)]
        line += [plus_minus(group.gap), plain(group.interval)]
        line.append(", ".join(plus_minus(runs.estimate("speed")) for runs in (home, away)))
        line.append(f"{plus_minus(away.estimate('distance'))}, {away.distance.min():.2f}")
        line.append(plus_minus(away.estimate("power"), 1))
        line.append(", ".join(f"{int(runs.balanced.sum())} of {len(runs)}" for runs in (home, group.described, away)))
        lines.append([*line, f"{group.far} of {len(away)}"])
    return table(header, lines)


def _weak(groups: Sequence[GroupGap]) -> list[str]:
    """Groups whose gap says little, since they do badly at home already."""
    return [
        f"**{group.label}** keeps its balance at home in only {_part(int(group.home.balanced.sum()))} of "
        f"{_count(len(group.home))} runs: part of what a gap could show is lost at home already."
        for group in groups
        if group.home.success_rate < 0.5
    ]


def _changes(comparison: Comparison, pairs: Sequence[tuple[GroupResult, GroupResult]]) -> list[str]:
    """How the gaps of pairs of groups differ, and what the paper found."""
    top, every = gap_groups(comparison, comparison.top), gap_groups(comparison)
    return [
        " ".join(
            [
                f"**{other.label}**, against **{base.label}**:",
                f"{_of(gap_difference(top[base.name], top[other.name]))}.",
                f"Of all their policies: {_of(gap_difference(every[base.name], every[other.name]))}.",
                *_paper(comparison.finding((base.name, other.name))),
            ]
        )
        for base, other in pairs
    ]


def _of(change: GapDifference) -> str:
    over_runs = f"{plus_minus(change.runs, sign=True)} m over runs"
    away = f"the return away changes by {plain(change.away, sign=True)} m"
    return f"the gap is {_larger(change.runs)} ({over_runs}; {_units(change.crossed)}); {away}"


def _larger(change: Estimate) -> str:
    size = f"{abs(change.mean):.2f}"
    return "the same" if size == "0.00" else f"{size} m {'larger' if change.mean > 0 else 'smaller'}"


def _units(change: Interval) -> str:
    if not change.known:
        return "too few policies or robots for an interval"
    covers = "includes" if change.covers_zero else "does not include"
    return f"over policies and robots {plain(change, sign=True)} m, which {covers} zero"


def _paper(finding: str) -> list[str]:
    return [f"In the paper, {finding}"] if finding else []


def _count(number: int) -> str:
    return _NUMBERS[number] if number < len(_NUMBERS) else str(number)


def _part(number: int) -> str:
    """So many of some."""
    return _count(number) if number else "none"


def _engine(world: str) -> str:
    return {
        "mujoco": "MuJoCo",
        "bullet": "Bullet with the robot's data sheet",
        "ensemble": f"an ensemble of {ROBOTS} robots in Bullet, each with hidden parameters, friction and play in its "
        "knees, an uneven floor and an IMU mounted askew: it stands where the paper has its robot",
    }.get(world, world)


def _title(name: str) -> str:
    words = name.replace("_", " ")
    return words[0].upper() + words[1:]


def _file(section: _Section) -> str:
    return f"gap_{section.name}.png"
