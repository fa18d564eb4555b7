"""Hooks of mkdocs: add the repository's files outside docs/, and reference pages that are generated from the code.

Links in sources are relative to the repository. In the site, README.md is the first page, docs/ is the root, and all
other folders keep their paths; links are rewritten accordingly.
"""

from __future__ import annotations

import ast
import contextlib
import dataclasses
import inspect
import io
import os
import posixpath
import re
import textwrap
import typing
from pathlib import Path

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

from surefoot.cli.main import GROUPS as COMMAND_GROUPS
from surefoot.cli.main import main
from surefoot.columns import columns_of
from surefoot.configuration import field_bounds
from surefoot.identify.recording import Recording, RecordingMeta
from surefoot.learn.config import PPOConfig, TrainConfig
from surefoot.robot.params import PARAMETER_GROUPS, PARAMETERS
from surefoot.task.commands import CommandConfig
from surefoot.task.config import FeedbackConfig, TaskConfig
from surefoot.task.leg_config import FootConfig, WaveConfig
from surefoot.task.observation import PARTS
from surefoot.task.pushes import PushConfig
from surefoot.task.reference_config import (
    FollowReferenceConfig,
    FootReferenceConfig,
    OverHolesConfig,
    SineReferenceConfig,
    TableReferenceConfig,
)
from surefoot.task.reward import TERMS
from surefoot.task.trace import EpisodeTrace, FurtherMeta, TraceMeta

os.environ |= {"COLUMNS": "76", "NO_COLOR": "1"}
ROOT = Path(__file__).resolve().parents[1]
OUTSIDE = (
    "CHANGELOG.md",
    "CITATION.cff",
    "CONTRIBUTING.md",
    "policies/README.md",
    "examples/first_hour.ipynb",
    "examples/sb3.py",
    "results/*.*",
    "results/*/*.*",
    "results/*/parameters/*",
)
MODULES = sorted(path.stem for path in ROOT.glob("src/surefoot/[a-z]*.py"))
PACKAGES = sorted(path.parent.name for path in ROOT.glob("src/surefoot/*/__init__.py"))


CONFIGURATIONS = {
    TaskConfig: "",
    FeedbackConfig: "feedback",
    SineReferenceConfig: "reference of kind sine",
    TableReferenceConfig: "reference of kind table",
    FootReferenceConfig: "reference of kind foot",
    FollowReferenceConfig: "reference of kind follow",
    WaveConfig: "reference.swing, extension, abduction",
    FootConfig: "reference.foot",
    OverHolesConfig: "reference.over_holes",
    CommandConfig: "commands",
    PushConfig: "pushes",
    TrainConfig: "train",
    PPOConfig: "train.ppo",
}
"""Dataclasses of a task file, and the tables that contain their fields."""
TYPES = {
    r"^dict.*": "table",
    r"^\w+Config.*": "table",
    r"Literal\[(.*?)\]": r"\1",
    r" \| None": "",
    r"tuple\[float, float\]": "two numbers",
    r"tuple\[(?:float|int), \.\.\.\]": "list of numbers",
    r"tuple\[str, \.\.\.\]": "list of names",
    r"^tuple.*": "list",
    r"^float": "number",
    r"^int": "integer",
    r"^str": "text",
    r"^bool": "true or false",
    r"Optional\[float\]": "number",
    r"^number \| table": "number, or table by leg",
    r"^number \| dict.*": "number, or table by leg",
}
"""Names of Python types in the reference, replaced in this order."""


def docstrings(kind: type) -> dict[str, str]:
    """Return the docstrings of a dataclass's fields, by name."""
    (body,) = ast.parse(textwrap.dedent(inspect.getsource(kind))).body
    assert isinstance(body, ast.ClassDef)
    pairs = zip(body.body, body.body[1:], strict=False)
    return {
        field.target.id: " ".join(text.value.value.split())
        for field, text in pairs
        if isinstance(field, ast.AnnAssign) and isinstance(field.target, ast.Name) and isinstance(text, ast.Expr)
    }


def fields_of(kind: type) -> list[str]:
    """Return one line per field of a dataclass: name, type, bounds, default and docstring."""
    hints, bounds, texts = typing.get_type_hints(kind), field_bounds(kind), docstrings(kind)
    lines = []
    for item in dataclasses.fields(kind):
        hint = hints[item.name]
        about = [re.sub(r"\b(\w+\.)+", "", hint.__name__ if isinstance(hint, type) else str(hint))]
        for pattern, words in TYPES.items():
            about = [re.sub(pattern, words, about[0])]
        if (within := bounds[item.name]).maximum < 1e12:
            least, greatest = (f"{round(bound, 5):,.9g}" for bound in (within.minimum, within.maximum))
            about.append(f"{'over ' if within.exclusive else ''}{least} to {greatest}")
        if dataclasses.is_dataclass(hint):
            about = ["table"]
        elif item.default is not dataclasses.MISSING:
            default = item.default if isinstance(item.default, tuple) else (item.default,)
            about.append(f"default {', '.join('none' if one is None else str(one) for one in default) or 'none'}")
        lines.append(f"- `{item.name}` ({'; '.join(about)}): {texts.get(item.name, '')}")
    return lines


def task_reference() -> str:
    """Return the page with every field of a task file, and the names of reward terms, observations and parameters."""
    text = [
        "# Task configuration",
        "Every field of a task's YAML file. A file contains only differences from the defaults or, with `base: TASK`, "
        "from a released task. The option for a field is `--task.FIELD`, and for a field of `train` `--FIELD`: "
        "`--task.reward.energy -0.004 --ppo.gamma 0.98`.",
    ]
    for kind, table in CONFIGURATIONS.items():
        text += [f"## {table or 'The file'}", (inspect.getdoc(kind) or "").split("\n")[0], "\n".join(fields_of(kind))]
    text += ["## Reward terms", "Names in `reward` and `reward_limits`. Costs have negative weights."]
    kinds = {True: "sum over a control step", False: "rate"}
    text += [
        "\n".join(f"- `{name}`, {kinds[term.is_sum]}: {term.unit} ({term.source})" for name, term in TERMS.items())
    ]
    text += ["## Observations", "Names in `observations`."]
    text += ["\n".join(f"- `{name}` [{part.unit}], {part.frame}" for name, part in PARTS.items())]
    about = "Names in `params` and `randomize`, and in the options `--set` and `--randomize.NAME`."
    text += ["## Physical parameters", about]
    for group in PARAMETER_GROUPS:
        rows = [f"- `{name}` [{one.unit}]: {one.meaning}" for name, one in PARAMETERS.items() if one.group == group]
        text += [f"### {group.capitalize()}", "\n".join(rows)]
    return "\n\n".join(text)


def columns_table(record: type) -> str:
    """Return the declared columns of a record as a table."""
    rows = ["| column | shape | unit | frame | meaning |", "|---|---|---|---|---|"]
    for name, one in columns_of(record).items():
        notes = [one.meaning.replace("|", "\\|"), *(["0 to 1"] if one.is_fraction else [])]
        notes += [] if one.known else ["NaN if unknown" if one.always_in_file else "not in the file if unknown"]
        rows.append(f"| `{name}` | {one.shape} | {one.unit} | {one.frame} | {'; '.join(notes)} |")
    return "\n".join(rows)


def trace_reference() -> str:
    """Return the page with the columns and metadata of traces and recordings."""
    return "\n\n".join(
        [
            "# Traces and recordings",
            "Contents of the files in which surefoot records a robot's motion: NumPy archives (.npz) of float64 "
            "arrays, with `meta`, a JSON table of metadata, and `robot`, the folder of a robot that does not ship.",
            "## Trace",
            "An episode of T control steps, simulated or real, with M motors, L legs, O observations and A feedback "
            "values. In columns with T+1 rows, row 0 is the start and row k is after control step k. Frames: x "
            "forward, y left, z up. Read the file with `EpisodeTrace.load` or `numpy.load`.",
            columns_table(EpisodeTrace),
            "### Metadata of every trace",
            "\n".join(fields_of(TraceMeta)),
            "### Optional metadata",
            "\n".join(fields_of(FurtherMeta)),
            "### Partial traces",
            "While `deploy` runs a robot, and while the drive page records, rows are written to `NAME.npz.partial`: a "
            "line of JSON (`kind`, `version`, `columns` with the number of values of each column in a row, `start` of "
            "columns with T+1 rows, `meta`, `robot`), then rows of little-endian float64. However the process ends, "
            "the rows written so far remain, and every command that reads traces also reads this file.",
            "## Recording of an experiment",
            "Data that `surefoot identify` records: C commands to a robot with M motors, and T of its states.",
            columns_table(Recording),
            "### Metadata",
            "\n".join(fields_of(RecordingMeta)),
        ]
    )


FORMS = {("train",): ["trot"], ("evaluate",): ["sensitivity"]}
"""Forms of commands with their own help, in addition to actions."""


def help_of(*words: str) -> str:
    """Return the help of a command."""
    with contextlib.redirect_stdout(io.StringIO()) as output, contextlib.suppress(SystemExit):
        main([*words, "--help"])
    return "\n".join(line.rstrip() for line in output.getvalue().splitlines())


def command_reference() -> str:
    """Return the page with the help of every command and of its actions."""
    text = ["# Commands", "Output of `surefoot COMMAND --help`."]
    for group, names in COMMAND_GROUPS.items():
        text.append(f"## {group.capitalize()}")
        for name in names:
            text += help_sections(name)
    return "\n\n".join(text)


def help_sections(*words: str) -> list[str]:
    """Return the sections with the help of a command and of its actions."""
    usage = help_of(*words)
    text = [f"{'#' * (len(words) + 2)} {' '.join(words)}", f"```text\n{usage}\n```"]
    parts = re.findall(r"^  ([a-z][a-z-]+) ", usage, re.M) if re.search("ACTION|EXPERIMENT", usage) else []
    for part in FORMS.get(words, parts):
        text += help_sections(*words, part)
    return text


def reference(title: str, modules: list[str]) -> str:
    """Return a page of API reference."""
    return "\n\n".join([f"# {title}", *(f"::: surefoot.{module}" for module in modules)])


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add README.md as the first page, the files outside docs/, and the API reference."""
    files.append(File.generated(config, "index.md", abs_src_path=str(ROOT / "README.md")))
    for path in sorted(path for pattern in OUTSIDE for path in ROOT.glob(pattern)):
        files.append(File.generated(config, path.relative_to(ROOT).as_posix(), abs_src_path=str(path)))
    for name in PACKAGES:
        files.append(File.generated(config, f"reference/{name}.md", content=reference(f"surefoot.{name}", [name])))
    pages = {"task-configuration": task_reference, "traces": trace_reference, "commands": command_reference}
    for name, make in pages.items():
        files.append(File.generated(config, f"reference/{name}.md", content=make()))
    files.append(File.generated(config, "reference/shared.md", content=reference("Shared modules", MODULES)))
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Rewrite relative links from repository paths to site paths."""
    source = page.file.abs_src_path
    if source is None:
        return markdown
    folder = Path(source).relative_to(ROOT).parent.as_posix()

    def rewritten(match: re.Match[str]) -> str:
        target = posixpath.normpath(posixpath.join(folder, match[1]))
        target = "index.md" if target == "README.md" else target.removeprefix("docs/")
        return f"]({posixpath.relpath(target, posixpath.dirname(page.file.src_uri) or '.')}"

    return re.sub(r"\]\((?!\w+:|#)([^)#\s]+)", rewritten, markdown)
