"""Synthetic third-party quadrupeds: a URDF and an MJCF with parts that tests replace."""

from __future__ import annotations

LEGS = (("FL", 0.18, 0.06), ("FR", 0.18, -0.06), ("RL", -0.18, 0.06), ("RR", -0.18, -0.06))
SPHERE = '<origin xyz="0 0 0"/><geometry><sphere radius="0.02"/></geometry>'


def link(name: str, mass: float, moments: tuple[float, float, float], shape: str, z: float = 0.0) -> str:
    """Return a link with a shape for visual and collision."""
    place = shape if "<origin" in shape else f'<origin xyz="0 0 {z}"/><geometry>{shape}</geometry>'
    xx, yy, zz = moments
    return (
        f'<link name="{name}"><inertial><origin xyz="0 0 {z}"/><mass value="{mass}"/>'
        f'<inertia ixx="{xx}" iyy="{yy}" izz="{zz}" ixy="0" ixz="0" iyz="0"/></inertial>'
        f"<visual>{place}</visual><collision>{place}</collision></link>"
    )


def joint(
    name: str, kind: str, parent: str, child: str, place: str, axis: str = "0 1 0", limits: str = 'lower="-1" upper="3"'
) -> str:
    """Return a joint; `limits` are attributes in addition to effort and velocity."""
    limit = "" if kind == "fixed" else f'<axis xyz="{axis}"/><limit {limits} effort="20" velocity="20"/>'
    ends = f'<parent link="{parent}"/><child link="{child}"/><origin xyz="{place}"/>'
    return f'<joint name="{name}" type="{kind}">{ends}{limit}</joint>'


def urdf(longer: float = 0.0, foot: str = SPHERE, more: str = "") -> str:
    """Return the URDF of a 10.6 kg quadruped made of boxes, with 0.4 m long legs.

    Args:
        longer: extra length of the back left thigh [m].
        foot: origin and geometry of the foot shapes, at the ankles.
        more: additional links and joints.
    """
    parts = [link("trunk", 6, (0.04, 0.09, 0.11), '<box size="0.4 0.2 0.1"/>')]
    for leg, x, y in LEGS:
        side, thigh = (1 if y > 0 else -1), 0.2 + (longer if leg == "RL" else 0.0)
        parts += [
            link(f"{leg}_hip", 0.4, (4e-4, 4e-4, 1e-4), '<cylinder radius="0.04" length="0.05"/>'),
            link(f"{leg}_thigh", 0.5, (2e-3, 2e-3, 5e-4), f'<box size="0.03 0.03 {thigh - 0.04}"/>', -thigh / 2),
            link(f"{leg}_calf", 0.2, (8e-4, 8e-4, 2e-4), '<box size="0.02 0.02 0.16"/>', -0.1),
            link(f"{leg}_foot", 0.05, (2e-5, 2e-5, 5e-6), foot),
            joint(f"{leg}_hip_joint", "revolute", "trunk", f"{leg}_hip", f"{x} {y} 0", "1 0 0",
                  'lower="-0.8" upper="0.8"'),
            joint(f"{leg}_thigh_joint", "revolute", f"{leg}_hip", f"{leg}_thigh", f"0 {0.08 * side} 0"),
            joint(f"{leg}_calf_joint", "revolute", f"{leg}_thigh", f"{leg}_calf", f"0 0 {-thigh}",
                  limits='lower="-2.7" upper="-0.8"'),
            joint(f"{leg}_foot_fixed", "fixed", f"{leg}_calf", f"{leg}_foot", "0 0 -0.2"),
        ]  # fmt: skip
    return "\n".join(['<robot name="odd">', *parts, more, "</robot>"])


def mjcf(
    actuators: str = "", joint_extra: str = "", more: str = "", compiler: str = "", order: str = "FL FR RL RR"
) -> str:
    """Return the MJCF of a 12.1 kg quadruped with 0.4 m long legs.

    Args:
        actuators: template of an actuator with `{joint}`, applied to every leg joint in order.
        joint_extra: attributes of every leg joint.
        more: additional elements.
        compiler: attributes of the compiler.
        order: order of the legs' actuators.
    """
    bodies = ""
    for leg, x, y in LEGS:
        hip, thigh, calf = (
            f'<joint name="{leg}_{part}_joint" axis="{axis}" range="{low} {high}" {joint_extra}/>'
            for part, axis, low, high in (
                ("hip", "1 0 0", -0.8, 0.8), ("thigh", "0 1 0", -1.5, 3.1), ("calf", "0 1 0", -2.8, -0.7)
            )
        )  # fmt: skip
        bodies += (
            f'<body name="{leg}_hip" pos="{x} {y} 0">{hip}<geom type="sphere" size="0.04" mass="0.5"/>'
            f'<body name="{leg}_thigh" pos="0 {0.08 if y > 0 else -0.08} 0">{thigh}'
            '<geom type="capsule" fromto="0 0 0 0 0 -0.2" size="0.02" mass="0.8"/>'
            f'<body name="{leg}_calf" pos="0 0 -0.2">{calf}<geom type="capsule" fromto="0 0 0 0 0 -0.2" size="0.01" '
            'mass="0.2"/><geom type="sphere" pos="0 0 -0.2" size="0.02" mass="0.02"/></body></body></body>'
        )
    joints = [f"{leg}_{part}_joint" for leg in order.split() for part in ("hip", "thigh", "calf")]
    acts = "".join(actuators.format(joint=name) for name in joints) if actuators else ""
    compiler = compiler or 'angle="radian"'
    return (
        f'<mujoco model="odd"><compiler {compiler}/><worldbody><body name="trunk" pos="0 0 0.4"><freejoint/>'
        f'<geom type="box" size="0.2 0.1 0.05" mass="6"/>{bodies}</body></worldbody>'
        f"<actuator>{acts}</actuator>{more}</mujoco>"
    )
