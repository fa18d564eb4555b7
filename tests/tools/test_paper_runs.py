"""`surefoot study paper`: the page of a clone, and the runs behind it."""

from __future__ import annotations

import csv
import json
import re
from pathlib import Path
from unittest import mock

import pytest
from paper_page import evaluations_on_page, load_content
from processes import surefoot

pytest.importorskip("matplotlib")
pytest.importorskip("mujoco")

import paper_runs
from paper_runs import PaperRuns, Stage, command, evaluations

from surefoot.cli.evaluate import EvaluateCommand
from surefoot.cli.evaluate_sensitivity import SensitivityCommand
from surefoot.cli.helpers.parsing import parse
from surefoot.cli.study import StudyCommand
from surefoot.cli.study_search import SearchCommand
from surefoot.cli.study_tune import TuneCommand
from surefoot.errors import SurefootError


def test_the_page_is_written_from_a_clone(repository: Path, tmp_path: Path):
    done = surefoot("study", "paper", "--root", repository, "--out", tmp_path / "page.html")
    assert (done.returncode, done.stdout) == (0, f"wrote {tmp_path / 'page.html'}\n")
    assert (tmp_path / "page.html").read_text(encoding="utf-8").endswith("</html>\n")


@pytest.fixture
def shipped(repository: Path, tmp_path: Path) -> Path:
    """Return a folder of runs in which the trot is trained."""
    (tmp_path / "runs/policies").mkdir(parents=True)
    (tmp_path / "runs/policies/trot.onnx").write_bytes((repository / "policies/trot.onnx").read_bytes())
    return tmp_path / "runs"


def test_runs_are_made_once_and_continue_after_a_stop(
    repository: Path, shipped: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    runs_made: list[str] = []

    def once(runs: PaperRuns) -> None:
        runs_made.append("once")
        (runs.folder / "once").touch()

    def stopped(runs: PaperRuns) -> None:
        runs_made.append("stopped")
        if runs_made.count("stopped") == 1:
            raise KeyboardInterrupt
        (runs.folder / "stopped").touch()

    stages = (Stage("once", once), Stage("results/evaluations.csv", evaluations), Stage("stopped", stopped))
    monkeypatch.setattr(paper_runs, "STAGES", stages)
    monkeypatch.setattr(paper_runs, "evaluations_on_page", lambda: ["trot"])
    words = ("study", "paper", "--root", repository, "--quick", "--out", shipped)
    done = surefoot(*words)
    assert done.returncode == 130
    assert f"surefoot study paper --root {repository} --quick" in done.stderr
    (row,) = csv.DictReader((shipped / "results/evaluations.csv").open())
    assert (row["name"], row["episodes"]) == ("trot", "5")
    assert not (shipped / "paper.html").exists()

    done = surefoot(*words)
    assert done.returncode == 0, done.stderr
    assert runs_made == ["once", "stopped", "stopped"]
    assert "results/evaluations.csv: exists" in done.stderr
    page = (shipped / "paper.html").read_text()
    assert paper_runs.QUICK_NOTE.split(":")[0] in page
    assert f"{float(row['speed_mean']):.2f} ± {float(row['speed_std']):.2f} m/s" in page
    assert "missing: results/evaluations gallop" in done.stdout


@pytest.mark.slow
def test_a_training_keeps_its_policy_and_pictures(repository: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(paper_runs, "STAGES", (paper_runs.train("trot", 8192),))
    folder = tmp_path / "runs"
    done = surefoot("study", "paper", "--root", repository, "--quick", "--out", folder)
    assert done.returncode == 0, done.stderr
    assert (folder / "policies/trot.onnx").exists()
    assert (folder / "policies/trot/footfalls.png").exists()


def test_a_command_that_fails_ends_the_runs_in_one_line(
    repository: Path, shipped: Path, monkeypatch: pytest.MonkeyPatch
):
    stages = (Stage("never", lambda runs: command(runs, "evaluate", "none.onnx")),)
    monkeypatch.setattr(paper_runs, "STAGES", stages)
    done = surefoot("study", "paper", "--root", repository, "--full", "--out", shipped)
    assert done.returncode == 2
    assert done.stderr.endswith("surefoot: error: surefoot evaluate none.onnx: ended with exit code 2\n")


def test_every_file_of_the_page_is_made_by_a_run_or_in_the_clone(repository: Path):
    folders = {Path(stage.makes).with_suffix("").parts[:2] for stage in paper_runs.STAGES}
    sections = load_content().sections
    lines = [line for part in sections for item in part.items for line in item.lines()]
    texts = [one.surefoot for one in (*sections, *lines)]
    files = {f"results/{match[1]}" for text in texts for match in re.finditer(r"\{([^ :{}]+)", text)}
    pictures = {one.file for part in sections for one in part.pictures}
    files |= {file for file in pictures if file.startswith("results/")}
    made = {stage.makes for stage in paper_runs.STAGES} | {"docs/motor.png"}
    assert {file for file in pictures if file.startswith("docs/")} <= made
    assert {("results", "search"), ("results", "from-scratch")} <= {Path(file).parts[:2] for file in files}
    for file in files:
        assert Path(file).parts[:2] in folders, file
    for stage in paper_runs.STAGES:
        if stage.makes.startswith("results/") and stage.makes.endswith("complete"):
            assert (repository / "studies" / f"{Path(stage.makes).parent.name}.yaml").exists()


PARSERS = {
    "evaluate": EvaluateCommand,
    "evaluate sensitivity": SensitivityCommand,
    "study": StudyCommand,
    "study tune": TuneCommand,
    "study search": SearchCommand,
}


def test_all_runs_are_valid_commands(repository: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    calls: list[list[str]] = []

    def main(words: list[str]) -> int:
        """Parse the words as the command would, and write the files that later runs need."""
        calls.append(words)
        length = 2 if " ".join(words[:2]) in PARSERS else 1
        name, rest = " ".join(words[:length]), words[length:]
        if name in PARSERS:
            # Ranges of --randomize and --push-force are ordinary words here.
            parse(PARSERS[name], rest, name)
        if name == "evaluate":
            print(json.dumps({"policy": str(rest[0]), "stance": {}}))
        if name == "evaluate sensitivity":
            folder = Path(rest[rest.index("--out") + 1])
            folder.mkdir(parents=True, exist_ok=True)
            (folder / "push_force.png").touch()
        if name == "study tune":
            Path(rest[rest.index("--out") + 1]).touch()
        if name == "train":
            run = Path(rest[1]) if rest[0] == "--resume" else Path("runs") / Path(rest[0]).stem / "first"
            (run / "figures").mkdir(parents=True, exist_ok=True)
            for file in ("config.yaml", "policy.onnx", "figures/footfalls.png"):
                (run / file).touch()
        return 0

    monkeypatch.setattr("surefoot.cli.main.main", main)
    run = mock.Mock(return_value=mock.Mock(returncode=0))
    monkeypatch.setattr(paper_runs.subprocess, "run", run)
    (tmp_path / "results/search").mkdir(parents=True)
    quick = PaperRuns(repository, tmp_path, True, workers=2)
    for stage in paper_runs.STAGES:
        stage.make(quick)
    commands = {tuple(words) for words in calls}
    assert ("train", "trot", "--out", "runs", "--steps", "300000") in commands
    assert (tmp_path / "policies/trot.onnx").exists()
    assert (tmp_path / "policies/trot/footfalls.png").exists()
    assert "trot,policies/trot.onnx" in (tmp_path / "results/evaluations.csv").read_text()
    assert (tmp_path / "results/handcrafted/trot-60.yaml").exists()
    evaluated = {words for words in commands if words[0] == "evaluate" and words[1] != "sensitivity"}
    assert len(evaluated) == len(evaluations_on_page()) > 5
    assert any("--push-force" in words for words in evaluated)
    assert (tmp_path / "docs/pushes.png").exists()
    scripts = [Path(call.args[0][1]).name for call in run.call_args_list]
    assert scripts == ["open_loop.py", "open_loop.py", "handcrafted.py"]
    assert run.call_args.args[0][1:3] == [str(repository / "benchmarks/handcrafted.py"), "results/handcrafted"]
    assert run.call_args.args[0][-4:] == ["--episodes", "5", "--conditions", "mujoco"]
    studies = [words for words in calls if words[0] == "study" and words[1].endswith(".yaml")]
    assert [Path(words[1]).is_file() for words in studies] == [True] * 4
    assert studies[0][2:6] == ["--workers", "2", "--steps", "60000"]
    assert " ".join(calls[-1]) == "study search gallop --out results/search --workers 2 --trials 4 --steps 60000"

    # The full version has no options of the small one, and continues an interrupted search.
    calls.clear()
    (tmp_path / "results/search/search.yaml").touch()
    full = PaperRuns(repository, tmp_path, False, ray="head:6379")
    for stage in paper_runs.STAGES:
        stage.make(full)
    assert ["train", "--resume", str(tmp_path / "runs/trot/first")] in calls
    assert " ".join(calls[-1]) == "study search gallop --out results/search --workers 0 --ray head:6379 --resume"
    assert not {"--steps", "--episodes", "--only", "--generations"} & {
        word for words in calls for word in words if words[0] != "evaluate" and "--push-force" not in words
    }
    run.return_value.returncode = 1
    with pytest.raises(SurefootError, match=r"handcrafted\.py: ended with exit code 1"):
        paper_runs.handcrafted(full)
    monkeypatch.setattr("surefoot.cli.main.main", lambda words: 130)
    with pytest.raises(KeyboardInterrupt):
        paper_runs.search(full)


def test_a_run_without_its_file_is_an_error(repository: Path, shipped: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(paper_runs, "STAGES", (Stage("results/none.json", lambda runs: None),))
    done = surefoot("study", "paper", "--root", repository, "--quick", "--out", shipped)
    refused_late = "surefoot: error: results/none.json was not made; see the output above\n"
    assert (done.returncode, done.stderr.endswith(refused_late)) == (2, True)
    done = surefoot("study", "paper", "--root", repository, "--full", "--out", shipped)
    assert done.returncode == 2
    assert "has results of --quick; give another --out for --full" in done.stderr
