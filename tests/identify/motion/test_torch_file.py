"""Reading of `torch.save` files without torch: only tensors are read."""

from __future__ import annotations

import os
import pickle
import zipfile
from pathlib import Path

import numpy as np
import pytest

from surefoot.errors import SurefootError
from surefoot.identify.motion import torch_file
from surefoot.identify.motion.column_table import read_table
from surefoot.identify.motion.torch_file import _rebuild_tensor, read_tensors

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


class Tensor:
    """Pickled as `_rebuild_tensor_v2` with any arguments."""

    def __init__(self, *arguments: object) -> None:
        self.arguments = arguments

    def __reduce__(self):
        return torch._utils._rebuild_tensor_v2, (*self.arguments, False, {})


def save(path: Path, data: object) -> None:
    """Write an archive of `torch.save` with a pickle of Python objects."""
    torch.save({"time": torch.zeros(4)}, path)
    with zipfile.ZipFile(path) as archive:
        contents = {name: archive.read(name) for name in archive.namelist()}
    with zipfile.ZipFile(path, "w") as archive:
        for name, content in contents.items():
            archive.writestr(name, pickle.dumps(data, 2) if name.endswith("data.pkl") else content)


def test_an_empty_tensor_of_many_rows_is_no_storage(tmp_path: Path):
    empty = Tensor(Tensor(0, 0, (), ()), 0, (2**33, 0), (1, 1))
    save(tmp_path / "log.pt", {"time": Tensor(empty, 0, (2**33,), (1,))})
    with pytest.raises(SurefootError, match="a tensor without its storage"):
        read_tensors(tmp_path / "log.pt")
    with pytest.raises(pickle.UnpicklingError, match="a tensor without its storage"):
        _rebuild_tensor(np.zeros((2**33, 0)), 0, (2**33,), (1,))


def test_tensors_of_one_storage_have_limited_memory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    base = torch.zeros(1000)
    torch.save({f"column{k}": base[:] for k in range(20)}, tmp_path / "log.pt")
    assert len(read_tensors(tmp_path / "log.pt")) == 20
    monkeypatch.setattr(torch_file, "FILE_BYTES", 50_000)
    with pytest.raises(SurefootError, match="its tensors have over"):
        read_tensors(tmp_path / "log.pt")
