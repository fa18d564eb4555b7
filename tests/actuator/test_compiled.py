"""Caches of compiled kernels: which source files make them stale."""

from pathlib import Path

from surefoot.actuator import compiled


def test_caches_depend_on_every_file_that_kernels_take_constants_from():
    package = Path(compiled.__file__).parents[1]
    sources = set(compiled.kernel_sources())
    for name in ("actuator/motor.py", "robot/actuator.py", "rotations.py", "world/contact.py", "world/ground.py"):
        assert package / name in sources


def test_an_edit_of_a_source_deletes_the_caches(tmp_path: Path, monkeypatch):
    for folder in ("actuator", "robot", "world"):
        (tmp_path / folder).mkdir()
    constants = tmp_path / "robot" / "actuator.py"
    constants.write_text("HEAT_LOSS = 1.0\n")
    monkeypatch.setattr(compiled, "_PACKAGE", tmp_path)
    monkeypatch.setattr(compiled, "_FOLDERS", [tmp_path / "actuator", tmp_path / "world"])
    compiled.drop_stale_caches()
    cache = tmp_path / "world" / "__pycache__" / "loop.nbc"
    cache.parent.mkdir()
    cache.touch()
    compiled.drop_stale_caches()
    assert cache.exists()
    constants.write_text("HEAT_LOSS = 2.0\n")
    compiled.drop_stale_caches()
    assert not cache.exists()
