"""Reading of `torch.save` files without torch: only tensors are read."""

from __future__ import annotations

import os
import zipfile
from pathlib import Path

import numpy as np
import pytest

from surefoot.errors import SurefootError
from surefoot.identify.motion.column_table import read_table
from surefoot.identify.motion.torch_file import read_tensors

torch = pytest.importorskip("torch")


class Hostile:
    def __reduce__(self):
        return os.system, ("exit 1",)


def test_tensors_of_all_layouts_are_what_torch_saved(tmp_path: Path):
    base = torch.arange(24, dtype=torch.float32).reshape(4, 6)
    saved = {
        "time": torch.linspace(0, 1, 4, dtype=torch.float64),
        "dof_pos": base[:, 1:4],  # a view with an offset and strides
        "des_dof_pos": base.t().contiguous().t(),
        "count": torch.tensor([1, 2, 3, 4]),
        "scalar": 3.0,
    }
    torch.save(saved, tmp_path / "log.pt")
    read = read_tensors(tmp_path / "log.pt")
    for name in ("time", "dof_pos", "des_dof_pos", "count"):
        np.testing.assert_array_equal(read[name], saved[name].numpy())
        assert read[name].dtype == saved[name].numpy().dtype
    table = read_table(tmp_path / "log.pt")
    np.testing.assert_array_equal(table.columns["dof_pos[2]"], base[:, 3].numpy())
    assert "scalar" not in table.columns


def test_no_code_in_a_file_is_executed(tmp_path: Path):
    torch.save({"time": torch.zeros(3), "bad": Hostile()}, tmp_path / "log.pt")
    with pytest.raises(SurefootError, match=r"it refers to (posix|nt).system, which is not allowed"):
        read_tensors(tmp_path / "log.pt")
    torch.save(torch.nn.Linear(2, 2), tmp_path / "model.pt")
    with pytest.raises(SurefootError, match="which is not allowed"):
        read_tensors(tmp_path / "model.pt")
    torch.save([torch.zeros(3)], tmp_path / "list.pt")
    with pytest.raises(SurefootError, match="holds a list; a log must be a dictionary of tensors"):
        read_tensors(tmp_path / "list.pt")


def test_damaged_files_are_rejected(tmp_path: Path):
    path = tmp_path / "log.pt"
    path.write_bytes(b"no archive")
    with pytest.raises(SurefootError, match=r"is not a file of torch.save with tensors: File is not a zip file"):
        read_tensors(path)
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("readme.txt", "nothing")
    with pytest.raises(SurefootError, match=r"holds no data.pkl"):
        read_tensors(path)
    # A tensor whose shape exceeds its bytes.
    torch.save({"time": torch.zeros(4)}, tmp_path / "good.pt")
    with zipfile.ZipFile(tmp_path / "good.pt") as good, zipfile.ZipFile(path, "w") as short:
        for item in good.namelist():
            content = good.read(item)
            short.writestr(item, content[:8] if "/data/" in item else content)
    with pytest.raises(SurefootError, match="a tensor that reaches beyond its storage"):
        read_tensors(path)
