"""Checks of the pages: links resolve, commands and options exist, and README's commands run."""

from __future__ import annotations

import ast
import functools
import glob
import posixpath
import re
import shlex
import shutil
import tomllib
import urllib.request
from collections.abc import Iterator
from fnmatch import fnmatch
from pathlib import Path

import pytest
from markdown_pages import PAGES, ROOT, anchors, blocks, commands, dead_links, lines, links
from page_commands import shortened
from processes import Emulator, emulators, serve_page, surefoot

from surefoot.cli.main import COMMANDS

README = ROOT / "README.md"
NO_COMMANDS = ("needs", "COMMAND", "1")
"""Second words of messages and protocol examples that start with the program's name."""


def names(paths: list[Path]) -> list[str]:
    return [path.relative_to(ROOT).as_posix() for path in paths]


def test_links_headings_and_commands_are_found():
    page = """# A page
See [it](b.md#two-words), ![a picture](c.png) and [that](https://d.org). Type `surefoot
show x`.
## Two *words*: `code_1`!
## Two *words*: `code_1`!

    surefoot train trot \\
        --steps 5        # a comment

```bash
surefoot emulate &
```
```python
surefoot.train("trot")  # [no](link.md)
```
"""
    assert links(page) == ["b.md#two-words", "c.png"]
    assert anchors(page) == {"a-page", "two-words-code_1", "two-words-code_1-1"}
    assert commands(page) == ["surefoot emulate", "surefoot train trot --steps 5", "surefoot show x"]


@pytest.mark.parametrize("page", names(PAGES))
def test_links_of_a_page_resolve_in_the_repository(page: str):
    assert dead_links(ROOT / page) == []


def test_a_missing_file_and_a_missing_heading_are_dead_links(tmp_path: Path):
    (tmp_path / "b.md").write_text("# There\n")
    (tmp_path / "README.md").write_text("[1](b.md#there) [2](b.md#not) [3](c.md) [4](#top)\n# Top\n")
    assert dead_links(tmp_path / "README.md") == ["b.md#not", "c.md"]


@pytest.mark.parametrize("page", ["README.md", "docs/why.md"])
def test_links_of_a_page_resolve_in_the_site(page: str):
    """The site consists of docs/, README and the files added by tools/site_hooks.py."""
    tree = ast.parse((ROOT / "tools" / "site_hooks.py").read_text(encoding="utf-8"))
    (outside,) = (
        ast.literal_eval(node.value)
        for node in tree.body
        if isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == "OUTSIDE"
    )
    for link in links((ROOT / page).read_text(encoding="utf-8")):
        target = posixpath.normpath(posixpath.join(posixpath.dirname(page), link.partition("#")[0] or Path(page).name))
        assert target.startswith("docs/") or any(fnmatch(target, one) for one in ("README.md", *outside)), link


def forms(command: str) -> Iterator[tuple[str, ...]]:
    """Yield the leading words of a command that have a separate help."""
    yield (command,)
    yield from {
        "train": [("train", "trot")],
        "evaluate": [("evaluate", "POLICY", "POLICY"), ("evaluate", "sensitivity")],
        "robot": [("robot", "firmware", "motor")],
        "identify": [("identify", "--trace", "TRACE")],
    }.get(command, [])
    yield from ((command, action) for action in actions(command))


@functools.cache
def usage(*words: str) -> str:
    return surefoot(*words, "--help").stdout


def actions(command: str) -> list[str]:
    """Return the subcommands and experiments listed in the help of a command."""
    text = usage(command)
    return re.findall(r"^  ([a-z][a-z-]+) ", text, re.MULTILINE) if re.search("ACTION|EXPERIMENT", text) else []


@functools.cache
def options(command: str) -> set[str]:
    """Return the options of all forms of a command."""
    texts = "".join(usage(*words) for words in forms(command))
    return {"--help", *re.findall(r"--[a-zA-Z][\w.-]*", texts)}


def unknown(line: str) -> list[str]:
    """Return the words of a command line that are not a command, subcommand or option."""
    from surefoot.robot.params import PARAMETERS
    from surefoot.task.reward import TERMS

    command, *words = shlex.split(line)[1:]
    if command.startswith("--") or command in NO_COMMANDS:
        return [] if command in ("--version", "--help", *NO_COMMANDS) else [command]
    if command not in COMMANDS:
        return [command]
    named = {"--randomize.": PARAMETERS, "--task.reward.": TERMS, "--task.reward-limits.": TERMS}
    found = [words[0]] if command == "robot" and words and words[0] not in actions(command) else []
    for word in (one.partition("=")[0] for one in words if one.startswith("--")):
        prefix = next((one for one in named if word.startswith(one)), None)
        if word not in options(command) and not (
            prefix and word.removeprefix(prefix).replace("-", "_") in named[prefix]
        ):
            found.append(word)
    return found


@pytest.mark.parametrize(
    ("line", "found"),
    [
        ("surefoot train trot --steps 5 --task.reward.velocity-error -4 --randomize.motor_strength 0.8 1", []),
        ("surefoot compare trot gallop", ["compare"]),
        ("surefoot robot make x.urdf", ["make"]),
        ("surefoot deploy trot --port P --runs 3", ["--runs"]),
        (
            "surefoot train trot --task.reward.speed 1 --randomize.colour 0 1",
            ["--task.reward.speed", "--randomize.colour"],
        ),
    ],
)
def test_unknown_commands_and_options_are_detected(line: str, found: list[str]):
    pytest.importorskip("mujoco")
    assert unknown(line) == found


@pytest.mark.parametrize("page", names(PAGES))
def test_commands_of_a_page_and_their_options_exist(page: str):
    pytest.importorskip("mujoco")
    text = (ROOT / page).read_text(encoding="utf-8")
    assert [line for line in commands(text) if unknown(line)] == []


def readme_lines() -> list[str]:
    return [line for block in blocks(README.read_text(encoding="utf-8")) for line in lines(block)]


def test_make_targets_extras_and_python_of_readme_exist():
    text = (ROOT / "Makefile").read_text(encoding="utf-8")
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    extras = project["optional-dependencies"]
    assert f"Python {project['requires-python'].removeprefix('>=')} or newer" in README.read_text(encoding="utf-8")
    for line in readme_lines():
        words = shlex.split(line)
        if words[0] == "make":
            assert re.search(rf"^{words[1]}:.* ## ", text, re.MULTILINE), line
        elif words[0] == "pip":
            assert words[:5] == ["pip", "install", "-c", "constraints.txt", "-e"], line
            assert set(words[5].strip(".[]").split(",")) <= set(extras), line
        elif words[0] != "surefoot":
            assert line == "python3 -m venv .venv && . .venv/bin/activate"


@pytest.mark.slow
def test_commands_of_readme_run_in_an_empty_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Trainings are shortened, and there is no robot on the network interface."""
    for package in ("torch", "mujoco", "viser", "cyclonedds"):
        pytest.importorskip(package)
    from surefoot.robot import RobotDescription

    monkeypatch.chdir(tmp_path)
    (tmp_path / "data").symlink_to(ROOT / "data")
    shutil.copy(RobotDescription.load("solo8").urdf.path, tmp_path / "mine.urdf")
    ran = []
    for line in (one for one in readme_lines() if one.startswith("surefoot ")):
        _, command, *words = shlex.split(line)
        words = [word for one in words for word in (glob.glob(one) if "*" in one else [one])]
        if command == "drive":
            with serve_page(command, *words, cwd=tmp_path) as address:
                assert urllib.request.urlopen(address).status == 200
        elif command == "emulate":
            with emulators(Emulator) as start:
                start(*words, "--domain", "93")
        elif "eth0" in words:
            done = surefoot(command, *words, "--domain", "93")
            assert done.returncode == 2, done.stderr
            assert "eth0" in done.stdout + done.stderr
        else:
            done = surefoot(command, *shortened(command, words))
            assert done.returncode == 0, f"{line}: {done.stdout[-2000:]}{done.stderr[-2000:]}"
        ran.append(command)
    assert set(ran) >= {"drive", "train", "show", "robot", "adopt", "doctor", "emulate"}


def test_no_page_installs_from_a_package_index():
    files = [README, *ROOT.glob("docs/*.md"), *ROOT.glob("examples/*.ipynb")]
    wrong = [path.name for path in files if re.search(r"pip install '?\"?surefoot", path.read_text(encoding="utf-8"))]
    assert wrong == []


def test_messages_in_troubleshooting_exist_in_the_code():
    symptoms = re.findall(r"^- \*\*(.*)\*\*", (ROOT / "docs" / "troubleshooting.md").read_text("utf-8"), re.MULTILINE)
    messages = [message for line in symptoms for message in re.findall(r"`([^`]+)`", line) if " " in message]
    files = [*ROOT.glob("src/**/*.py"), ROOT / "Makefile"]
    source = re.sub(r'"\s*\n\s*f?"', "", "\n".join(path.read_text(encoding="utf-8") for path in files))
    values = re.compile(r"\.\.\.|\b[NX]\b|MODULE|policy\.onnx")
    parts = {part.strip(" ':") for message in messages for part in values.split(message)}
    assert len(messages) > 10
    assert [part for part in parts if part not in source] == []
