"""Malicious files for `fuzz.py`: MJCF with huge sizes, COLLADA with nested nodes, changed checkpoints with a digest."""

from __future__ import annotations

import random
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

COUNTS = ("0", "-1", "1", "7", "1000", "100000", "2000000000", "2147483647", "1e30", "nan", "1 1", "x")
SIZES = (
    *("nuser_body", "nuser_jnt", "nuser_geom", "nuser_site", "nuser_cam", "nuser_tendon", "nuser_actuator"),
    *("nuser_sensor", "nkey", "nuserdata", "memory", "njmax", "nconmax", "nstack"),
)
MESHES = ("sphere", "hemisphere", "cone", "supersphere", "supertorus", "wedge", "plate", "prism")
JUNK: tuple[Any, ...] = (
    *(None, True, 0, -1, 1, 2.5, 1e30, 10**40, float("nan"), float("inf"), "", "x", [], {}, [[]], {"a": {}}),
    *(np.zeros(3), np.zeros((0, 2)), np.full(2, np.nan), np.array(1), np.zeros(2, bool)),
)


def _quadruped() -> str:
    """Return the MJCF of a robot with four legs of three hinges."""
    legs = ""
    for name, x, y in (("FL", 0.2, 0.1), ("FR", 0.2, -0.1), ("RL", -0.2, 0.1), ("RR", -0.2, -0.1)):
        inside = '<geom type="sphere" size=".02" pos="0 0 -.2"/>'
        for part, axis, place in (("calf", "0 1 0", "0 0 -.2"), ("thigh", "0 1 0", "0 .08 0"), ("hip", "1 0 0", "")):
            place = place or f"{x} {y} 0"
            limits = ' range="-2.5 -.5"' if part == "calf" else ' range="-1 1"'
            inside = (
                f'<body name="{name}_{part}" pos="{place}"><inertial pos="0 0 -.1" mass=".5" diaginertia=".002 .002 '
                f'.001"/><joint name="{name}_{part}_joint" axis="{axis}"{limits} actuatorfrcrange="-20 20"/>{inside}'
                "</body>"
            )
        legs += inside
    base = '<freejoint/><inertial pos="0 0 0" mass="5" diaginertia=".05 .1 .1"/><geom type="box" size=".2 .1 .05"/>'
    return (
        f'<mujoco model="dog"><compiler angle="radian" autolimits="true"/><asset></asset><worldbody><body name="base" '
        f'pos="0 0 .5">{base}{legs}</body></worldbody></mujoco>'
    )


def make_models(folder: Path) -> None:
    """Write `dog.xml`, an MJCF, and `meshed/dog.urdf` with its mesh `body.dae`."""
    from surefoot.robot import RobotDescription

    (folder / "dog.xml").write_text(_quadruped())
    (folder / "meshed").mkdir()
    urdf = RobotDescription.load("solo8").urdf.path.read_text()
    visual = '<visual><geometry><mesh filename="body.dae"/></geometry></visual></link>'
    (folder / "meshed" / "dog.urdf").write_text(urdf.replace("</link>", visual, 1))
    (folder / "meshed" / "body.dae").write_text(_collada())


def _collada() -> str:
    """Return a COLLADA file of a tetrahedron."""
    accessor = '<accessor source="#pa" count="4" stride="3">' + "".join(
        f'<param name="{axis}" type="float"/>' for axis in "XYZ"
    )
    return (
        '<?xml version="1.0"?>\n<COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1">\n'
        '<asset><unit name="meter" meter="1"/><up_axis>Z_UP</up_axis></asset>\n'
        '<library_geometries><geometry id="g"><mesh><source id="p"><float_array id="pa" count="12">'
        "0 0 0 .1 0 0 0 .1 0 0 0 .1</float_array>\n"
        f"<technique_common>{accessor}</accessor></technique_common></source>\n"
        '<vertices id="v"><input semantic="POSITION" source="#p"/></vertices>\n'
        '<triangles count="4"><input semantic="VERTEX" source="#v" offset="0"/>'
        "<p>0 2 1 0 1 3 0 3 2 1 2 3</p></triangles></mesh></geometry></library_geometries>\n"
        '<library_visual_scenes><visual_scene id="w"><node id="n"><instance_geometry url="#g"/></node></visual_scene>'
        '</library_visual_scenes>\n<scene><instance_visual_scene url="#w"/></scene></COLLADA>\n'
    )


def expand_mjcf(content: bytes, rng: random.Random) -> bytes:
    """Return an MJCF with one or two elements that MuJoCo expands, of any size."""
    text = content.decode()
    for _ in range(rng.choice((1, 1, 2))):
        count = [rng.choice(COUNTS) for _ in range(3)]
        top, asset, inside = "", "", ""
        what = rng.randrange(9)
        if what == 0:
            top = f'<size {rng.choice(SIZES)}="{count[0]}"/>'
        elif what == 1:
            asset = f'<mesh name="h" builtin="{rng.choice(MESHES)}" params="{" ".join(count)}"/>'
            inside = '<geom type="mesh" mesh="h" mass="1"/>'
        elif what == 2:
            asset = f'<hfield name="h" nrow="{count[0]}" ncol="{count[1]}" size="1 1 1 1"/>'
            inside = '<geom type="hfield" hfield="h"/>'
        elif what == 3:
            asset = f'<texture name="h" type="2d" builtin="flat" width="{count[0]}" height="{count[1]}"/>'
        elif what == 4:
            grid = f'type="grid" count="{" ".join(count)}" spacing=".1 .1 .1" dim="{rng.randrange(4)}"'
            inside = f'<flexcomp name="h" {grid} mass="1"/>'
        elif what == 5:
            inside = '<site size=".1"/>'
            for level in range(rng.choice((1, 3, 12, 300))):
                inside = f'<replicate count="{rng.choice(COUNTS)}" offset="1 0 0" sep="s{level}">{inside}</replicate>'
        elif what == 6:
            asset = '<model name="h" file="dog.xml"/>'
            inside = '<body><attach model="h" prefix="h"/></body>'
        elif what == 7:
            top = f'<include file="{rng.choice(("dog.xml", "/dev/zero", "/proc/self/mem", "..", "x"))}"/>'
        else:
            count = [rng.choice(("10", "2000", "30000"))]
            inside = int(count[0]) * rng.choice(("<body>", "<site/>", '<geom size="1"/>'))
            inside += int(count[0]) * "</body>" if inside.startswith("<body>") else ""
        text = text.replace("<asset>", f"{top}<asset>{asset}", 1).replace("<worldbody>", f"<worldbody>{inside}", 1)
    return text.encode()


def expand_collada(content: bytes, rng: random.Random) -> bytes:
    """Return a COLLADA file with nodes nested many times, to any depth, with and without geometries."""
    width, levels = rng.choice((1, 2, 10, 100)), rng.choice((1, 3, 11, 40, 1500))
    last = rng.choice(
        ("", '<instance_geometry url="#g"/>', '<instance_node url="#n"/>', f'<instance_node url="#b{levels}"/>')
    )
    nodes = f'<node id="b0">{last}</node>'
    if width == 1 and rng.random() < 0.5:
        nodes = f'{levels * "<node>"}{last}{levels * "</node>"}<node id="b{levels}"/>'
    else:
        for level in range(1, levels + 1):
            names = rng.choice((f"#b{level - 1}", f"#b{level - 1}", "#none", "b0"))
            nodes += f'<node id="b{level}">{width * f"""<instance_node url="{names}"/>"""}</node>'
    text = content.decode()
    text = text.replace("<library_visual", f"<library_nodes>{nodes}</library_nodes><library_visual", 1)
    return text.replace('<node id="n">', f'<node id="n"><instance_node url="#b{levels}"/>', 1).encode()


def change_checkpoint(content: bytes, rng: random.Random) -> bytes:
    """Return a checkpoint with one changed value and a matching digest."""
    from surefoot.learn.run_folder import read_checkpoint, write_checkpoint

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "a.ckpt"
        path.write_bytes(content)
        write_checkpoint(path, _change(read_checkpoint(path), rng))
        return path.read_bytes()


def _change(value: Any, rng: random.Random) -> Any:
    """Return a state with one value at any depth replaced, dropped, reshaped or set to NaN."""
    import torch

    if isinstance(value, dict) and value and rng.random() < 0.95:
        key = rng.choice(list(value))
        what = rng.random()
        if what < 0.05:
            return {name: item for name, item in value.items() if name != key}
        if what < 0.08:
            return {**value, rng.choice(("x", 7, None)): value[key]}
        return {**value, key: _change(value[key], rng)}
    if isinstance(value, list) and value and rng.random() < 0.9:
        at = rng.randrange(len(value))
        return [*value[:at], *([] if rng.random() < 0.1 else [_change(value[at], rng)]), *value[at + 1 :]]
    if isinstance(value, np.ndarray | torch.Tensor) and rng.random() < 0.7:
        array = np.array(value)
        if (what := rng.randrange(5)) == 0:
            array = array.reshape(-1)
        elif what == 1:
            array = array[:1] if array.ndim else array[None]
        elif what == 2:
            array = array.astype(rng.choice(("f4", "f8", "i8", "?")))
        elif array.size:
            array = array.copy()
            whole = (0, 1, -1, 2**62) if array.dtype.kind == "i" else (0, 1)
            numbers = (np.nan, np.inf, -1e30, 1e30, -1, 0) if array.dtype.kind == "f" else whole
            array.reshape(-1)[rng.randrange(array.size)] = rng.choice(numbers)
        return torch.from_numpy(array) if isinstance(value, torch.Tensor) else array
    return rng.choice(JUNK)


EXPANSIONS: dict[str, Callable[[bytes, random.Random], bytes]] = {
    ".xml": expand_mjcf,
    ".dae": expand_collada,
    ".ckpt": change_checkpoint,
}
"""Changes of each kind of file, in addition to damaged bytes and words."""
