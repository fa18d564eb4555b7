"""Modified copies of released policies and robots."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from surefoot.api.policies import find_policy
from surefoot.policy.contract import METADATA_KEY
from surefoot.policy.digest import add_digest
from surefoot.robot import RobotDescription


def modified_policy(
    path: Path,
    change: Callable[[dict[str, Any]], object] = lambda contract: None,
    policy: str | Path = "gallop",
    graph: Callable[[Any], object] = lambda graph: None,
) -> Path:
    """Write a policy with a modified contract and graph and a matching digest."""
    onnx = pytest.importorskip("onnx")
    model = onnx.load(find_policy(str(policy)))
    contract = json.loads(next(entry.value for entry in model.metadata_props if entry.key == METADATA_KEY))
    change(contract)
    graph(model.graph)
    onnx.helper.set_model_props(model, {METADATA_KEY: json.dumps(contract)})
    path.write_bytes(add_digest(model.SerializeToString()))
    return path


def maxitaur(folder: Path) -> Path:
    """Copy the robot minitaur to a folder under the name maxitaur; return the folder."""
    shutil.copytree(RobotDescription.load("minitaur").folder, folder)
    sheet = folder / "robot.toml"
    sheet.write_text(sheet.read_text().replace('name = "minitaur"', 'name = "maxitaur"'))
    return folder
