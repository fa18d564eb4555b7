"""Logs in Parquet files, as LeRobot writes them: columns of lists, several episodes in a file, and damaged files."""

from __future__ import annotations

import os
import pickle
import sys
from pathlib import Path

import numpy as np
import pytest
from processes import assert_rejected, run_surefoot

from surefoot.errors import SurefootError
from surefoot.identify.motion import column_table
from surefoot.identify.motion.column_table import read_table
from surefoot.identify.motion.importing import import_log
from surefoot.robot import RobotDescription
from surefoot.task.trace import EpisodeTrace

EPISODES = (30, 40)
"""Rows of the episodes 4 and 5."""
FPS = 50


def episodes() -> dict[str, np.ndarray]:
    """Return two runs of a robot whose readings are a row behind its commands."""
    frame = np.concatenate([np.arange(count) for count in EPISODES])
    action = np.sin(0.1 * np.arange(len(frame))[:, None] + np.arange(12))
    return {
        "action": action.astype(np.float32),
        "observation.state": np.roll(action, 1, axis=0).astype(np.float32),
        "timestamp": (frame / FPS).astype(np.float32),
        "frame_index": frame,
        "episode_index": np.repeat([4, 5], EPISODES),
        "next.done": np.isin(np.arange(len(frame)), np.cumsum(EPISODES) - 1),
    }


@pytest.fixture
def written(tmp_path: Path) -> Path:
    """A file of pyarrow's in the layout of LeRobot, with columns that are no numbers."""
    arrow, parquet = pytest.importorskip("pyarrow"), pytest.importorskip("pyarrow.parquet")
    columns = {}
    for name, array in episodes().items():
        flat = arrow.array(array.ravel())
        columns[name] = arrow.FixedSizeListArray.from_arrays(flat, array.shape[1]) if array.ndim == 2 else flat
    rows = sum(EPISODES)
    columns["action"] = columns["action"].cast(arrow.list_(arrow.float32()))
    columns["task"] = arrow.array(["walk"] * rows)
    columns["observation.images.front"] = arrow.array([{"bytes": b"\x89PNG", "path": "0.png"}] * rows)
    columns["tokens"] = arrow.array([[1] * (k % 3) for k in range(rows)])
    columns["force"] = arrow.array([None, *range(rows - 1)])
    columns["grid"] = arrow.array([[[k, 1], [2, 3], [4, 5]] for k in range(rows)])
    parquet.write_table(
        arrow.table(columns), tmp_path / "file-000.parquet", row_group_size=17, write_page_checksum=True
    )
    return tmp_path / "file-000.parquet"


def mapping(path: Path, robot: RobotDescription, more: str = "", state: str = "observation.state") -> Path:
    lines = ["time: {column: timestamp}", more, "motors:"]
    lines += [
        f"  {name}: {{command: 'action[{k}]', angle: '{state}[{k}]'}}" for k, name in enumerate(robot.motor_names)
    ]
    path.write_text("\n".join(lines))
    return path


def test_columns_of_numbers_are_read_and_others_left_out(written: Path):
    columns = read_table(written).columns
    expected = episodes()
    assert {name.partition("[")[0] for name in columns} == {*expected, "force", "grid"}
    np.testing.assert_array_equal(columns["observation.state[7]"], expected["observation.state"][:, 7])
    np.testing.assert_array_equal(columns["action[11]"], expected["action"][:, 11])
    np.testing.assert_array_equal(columns["next.done"], expected["next.done"])
    np.testing.assert_array_equal(columns["force"][:3], [np.nan, 0, 1])
    np.testing.assert_array_equal(columns["grid[0,0]"], np.arange(70))
    np.testing.assert_array_equal(columns["grid[2,1]"], np.full(70, 5))


def test_one_episode_of_several_is_imported(written: Path, tmp_path: Path, pupper: RobotDescription):
    expected = episodes()
    which = mapping(tmp_path / "m.yaml", pupper, "rows: {episode_index: 5}")
    motion = import_log(written, pupper, which)
    np.testing.assert_allclose(motion.time, np.arange(40) / FPS, atol=1e-7)
    np.testing.assert_array_equal(motion.command, expected["action"][30:])
    np.testing.assert_array_equal(motion.motor_angle, expected["observation.state"][30:])
    # The command makes a trace of it.
    done = run_surefoot(
        *("identify", "import", written, "--robot", "pupper_v2", "--map", which, "--out", tmp_path / "trace.npz")
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("40 rows, 0.78 s; steps of 20.00 to 20.00 ms")
    assert "these times look computed, not measured" in done.stdout
    np.testing.assert_array_equal(EpisodeTrace.load(tmp_path / "trace.npz").target, motion.command)


@pytest.mark.parametrize(
    ("more", "state", "message"),
    [
        ("", "observation.state", r"has several runs: time starts again where episode_index changes; choose one in the "
         r"mapping, such as rows: \{episode_index: 4\}"),
        ("rows: {episode_index: 6}", "observation.state", "has no rows with episode_index 6; episode_index is 4 to 5"),
        ("rows: {episode: 4}", "observation.state", "has no column 'episode'; columns: action"),
        ("rows: {episode_index: first}", "observation.state", "rows.episode_index is 'first'"),
        ("rows: {episode_index: 4}", "state", r"has no column 'state\[0\]'; columns: action\[0\]"),
    ],
)  # fmt: skip
def test_what_does_not_fit_the_file_is_refused(
    written: Path, tmp_path: Path, pupper: RobotDescription, more: str, state: str, message: str
):
    with pytest.raises(SurefootError, match=message) as caught:
        import_log(written, pupper, mapping(tmp_path / "m.yaml", pupper, more, state))
    assert "\n" not in str(caught.value)


def test_runs_of_other_files_are_chosen_too(tmp_path: Path, pupper: RobotDescription):
    np.savez(tmp_path / "log.npz", **episodes())
    motion = import_log(tmp_path / "log.npz", pupper, mapping(tmp_path / "m.yaml", pupper, "rows: {episode_index: 4}"))
    np.testing.assert_array_equal(motion.command, episodes()["action"][:30])


def test_damaged_files_are_refused(written: Path):
    whole = written.read_bytes()
    changed = bytearray(whole)
    changed[200] ^= 255
    for content in (b"", b"PAR1", whole[:-100], whole[100:], bytes(changed)):
        written.write_bytes(content)
        with pytest.raises(SurefootError, match=r"is no Parquet file that can be read: ") as caught:
            read_table(written)
        assert "\n" not in str(caught.value)


def test_too_many_values_are_refused_before_they_are_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Equal numbers take next to no space: four million of them some kilobytes."""
    arrow, parquet = pytest.importorskip("pyarrow"), pytest.importorskip("pyarrow.parquet")
    table = arrow.table({"timestamp": np.zeros(1_000_000), "action": [[0.0] * 3] * 1_000_000})
    parquet.write_table(table, tmp_path / "log.parquet")
    assert (tmp_path / "log.parquet").stat().st_size < 40_000
    monkeypatch.setattr(column_table, "MAX_NUMBERS", 1_000_000)
    with monkeypatch.context() as patch:
        patch.setattr(parquet.ParquetFile, "read", None)
        with pytest.raises(SurefootError, match="holds 4000000 values; at most 1000000 are read"):
            read_table(tmp_path / "log.parquet")


class Hostile:
    """Makes a folder where it is unpickled."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def __reduce__(self):
        return os.mkdir, (str(self.folder),)


def test_types_that_a_file_names_are_not_built(tmp_path: Path):
    """Old versions of pyarrow unpickled a type of a file's own."""
    arrow, parquet = pytest.importorskip("pyarrow"), pytest.importorskip("pyarrow.parquet")
    code = pickle.dumps(Hostile(tmp_path / "made"))
    named = {"ARROW:extension:name": "arrow.py_extension_type", "ARROW:extension:metadata": code}
    field = arrow.field("timestamp", arrow.float64(), metadata=named)
    table = arrow.table([np.arange(3.0)], schema=arrow.schema([field]))
    parquet.write_table(table, tmp_path / "log.parquet")
    np.testing.assert_array_equal(read_table(tmp_path / "log.parquet").columns["timestamp"], np.arange(3.0))
    assert not (tmp_path / "made").exists()


def test_a_missing_package_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    (tmp_path / "log.parquet").write_bytes(b"PAR1")
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    with pytest.raises(SurefootError, match="reading it needs pyarrow: pip install pyarrow, or save the log as CSV"):
        read_table(tmp_path / "log.parquet")
    assert_rejected(
        run_surefoot("identify", "import", tmp_path / "x.parquet", "--robot", "go2", "--out", "x.npz"), "No such"
    )
