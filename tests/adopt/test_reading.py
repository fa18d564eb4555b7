"""Third-party configurations as people write them: values, computed expressions, notes, errors and overrides.

Networks are random; files are made here, of the kinds in which public ones differ.
"""

from __future__ import annotations

import numpy as np
import pytest
import yaml
from third_party_policies import DATA, DEPLOY, perceptron

from surefoot.adopt.adoption import adopt
from surefoot.adopt.formats.common import match_joints, unmeasured_reason
from surefoot.adopt.formats.python_values import Computed, read_classes
from surefoot.errors import SurefootError
from surefoot.policy.runtime import PolicyRuntime

POSE = (
    "{"
    + ", ".join(
        f'"{leg}_{part}_joint": {angle}'
        for leg in ("FL", "FR", "RL", "RR")
        for part, angle in (("hip", 0.0), ("thigh", 0.8), ("calf", -1.5))
    )
    + "}"
)
GYM = f"""
class Config:
    class init_state:
        default_joint_angles = {POSE}

    class control:
        stiffness = {{"joint": 25.0}}
        damping = {{"joint": 0.5}}
        action_scale = 0.25
        decimation = 4
"""
MANUAL = {
    "default_pose": [0.0, 0.8, -1.5] * 4,
    "kp": 25,
    "kd": 0.5,
    "control_step": 0.02,
    "action_scale": 0.25,
    "observations": [
        *({"term": name} for name in ("angular_velocity", "gravity", "command", "joint_positions", "joint_speeds")),
        {"term": "last_action"},
    ],
}


@pytest.fixture
def take(go2, tmp_path):
    """Return a function that adopts a random network of a given width with a configuration."""

    def take(kind: str, config, inputs: int = 45, **changes):
        network, path = tmp_path / "policy.onnx", tmp_path / ("config.py" if kind == "legged_gym" else "config.yaml")
        network.write_bytes(perceptron(inputs))
        path.write_text(config if isinstance(config, str) else yaml.safe_dump(config, sort_keys=False))
        return adopt(network, kind, go2, "x", path, changes).specification

    return take


def rejection(take, *words, **options) -> str:
    with pytest.raises(SurefootError) as caught:
        take(*words, **options)
    assert "\n" not in str(caught.value)
    return str(caught.value)


@pytest.mark.parametrize(
    ("name", "what"),
    [
        *((name, "speed of the base") for name in ("linear_velocity", "base_lin_vel", "lin_vel", "velocity", "vel_xy")),
        *((name, "speed of the base") for name in ("baseLinearVelocity", "estimated_velocity", "body speed")),
        *((name, "contact of the feet") for name in ("foot_contacts", "feet_contact", "foot_forces", "contact_states")),
        *((name, "height of the ground") for name in ("height_scan", "depth_image", "terrain_heights", "lidar_rays")),
        *((name, "height of the base") for name in ("base_height", "base_z")),
        ("base_pos", "position of the base"),
    ],
)
def test_unmeasured_observations_are_recognized_by_name(take, name, what):
    assert what in unmeasured_reason(name)
    manual = {**MANUAL, "observations": [{"term": name}, *MANUAL["observations"]]}
    message = rejection(take, "manual", manual, 48)
    assert f"observations[0].term is '{name}', which is the {what}" in message
    assert "did you mean" not in message


@pytest.mark.parametrize(
    "name", ["ang_vel", "joint_vel", "dof_velocities", "gyro", "velocity_commands", "gravity", "phase"]
)
def test_measured_observations_are_not_mistaken_for_unmeasured_ones(name):
    assert unmeasured_reason(name) is None


def test_joints_match_without_the_affixes_of_frameworks(take, go2):
    short = [name.removesuffix("_joint") for name in go2.motor_names]
    specification = take("manual", {**MANUAL, "joints": short})
    assert specification.joints == go2.motor_names
    assert specification.notes["names"] == "names of joints: FR_hip is go2's FR_hip_joint, and so on"
    assert match_joints(["fr-hip", "FR.Thigh.joint"], go2.motor_names) == ("FR_hip_joint", "FR_thigh_joint")
    assert match_joints(["FR_hip", "FR_knee"], go2.motor_names) is None
    message = rejection(take, "manual", {**MANUAL, "joints": ["FR_knee", *short[1:]]})
    assert "joints are FR_knee" in message


def test_top_level_sections_are_read_as_nested_classes(take):
    flat = "\n".join(line.removeprefix("    ") for line in GYM.splitlines() if not line.startswith("class Config"))
    assert take("legged_gym", flat) == take("legged_gym", GYM)


def test_only_arithmetic_of_literals_is_evaluated():
    values = read_classes(
        b"""
HALF = 0.5
class Config:
    class control:
        base = 0.5
        action_scale = HALF * base
        decimation = 2 ** 2
        stiffness = {"joint": -(-20.0)}
        gains = [20.0] * 3
        damping = {"joint": compute()}
        huge = 10 ** 10 ** 10
    class sim:
        dt = 1 / 400
        if True:
            dt = 0.01
Config.control.decimation = 8 // 2
""",
        (),
    )
    assert values["control.action_scale"] == 0.25
    assert values["control.decimation"] == 4
    assert values["control.stiffness"] == {"joint": 20.0}
    assert values["control.gains"] == [20.0] * 3
    assert values["control.damping"] == Computed("{'joint': compute()}")
    assert isinstance(values["control.huge"], Computed)
    assert isinstance(values["sim.dt"], Computed)


def test_values_that_are_changed_in_place_are_computed():
    values = read_classes(
        b"""
class Config:
    class control:
        stiffness = {"hip": 20.0}
        stiffness["calf"] = 40.0
        damping = {"hip": 0.5}
        damping.update({"calf": 1.0})
        action_scale, decimation = 0.25, 8
        gains = {"hip": [1.0]}
        gains["hip"].append(2.0)
        kept = stiffness.get("hip")
        other = {"hip": 1.0}
    class init_state:
        default_joint_angles = {"hip": 0.1}
        for joint in default_joint_angles:
            default_joint_angles[joint] = 0.0
Config.control.other["calf"] = 2.0
Config.noise.scale.update(a=1)
""",
        (),
    )
    names = ("stiffness", "damping", "action_scale", "decimation", "gains", "kept", "other")
    for name in (*(f"control.{one}" for one in names), "init_state.default_joint_angles", "noise.scale"):
        assert isinstance(values[name], Computed), name
    assert values["control.stiffness"].text == "stiffness['calf'] = 40.0"


def test_a_number_of_too_many_digits_is_no_traceback():
    assert "a.x" in read_classes(b"class C:\n    class a:\n        x = [0x" + b"f" * 4000 + b"]\n", ())


def test_a_read_does_not_make_a_value_computed():
    values = read_classes(
        b"class C:\n    class a:\n        x = {'k': 1}\n        y = x.copy()\n        print(x['k'])\n", ()
    )
    assert values["a.x"] == {"k": 1}


def test_options_replace_values_that_cannot_be_read(take):
    gym = GYM.replace('{"joint": 25.0}', "gains()").replace('{"joint": 0.5}', '{"joint": 1, "calf": 2}')
    gym += "    class commands:\n        class ranges:\n            lin_vel_x = limits()\n"
    assert "control.stiffness is computed" in rejection(take, "legged_gym", gym, forward=(-0.5, 0.8))
    specification = take("legged_gym", gym, kp=30.0, kd=1.0, forward=(-0.5, 0.8))
    assert (specification.kp, specification.kd, specification.forward) == (30.0, 1.0, (-0.5, 0.8))


def test_computed_values_are_rejected(take):
    assert take("legged_gym", GYM.replace("= 0.25", "= 0.5 * 0.5")) == take("legged_gym", GYM)
    message = rejection(take, "legged_gym", GYM.replace("= 0.25", "= scale()"))
    assert message.endswith("control.action_scale is computed ('scale()'); write the value itself")


@pytest.mark.parametrize("key", ["hip_scale_reduction", "hip_reduction"])
def test_the_action_scale_of_hips_is_reduced(take, key):
    specification = take("legged_gym", GYM + f"        {key} = 0.5\n")
    assert specification.action_scale == (0.125, 0.25, 0.25) * 4
    assert "0.125 rad" in specification.notes["action_scale"]


def test_unread_keys_are_noted(take):
    more = "        use_filter = True\n        action_scal = 3.0\n    class controll:\n        decimation = 2\n"
    note = take("legged_gym", GYM + more).notes["unread"]
    assert "control.use_filter = True" in note
    assert "control.action_scal = 3.0" in note
    assert "controll = 'a class' (did you mean control?)" in note
    assert "unread" not in take("legged_gym", GYM + "        control_type = 'P'\n").notes
    deploy = {**DEPLOY, "action_filter": 0.8}
    assert "action_filter = 0.8" in take("unitree_rl_lab", deploy, 175).notes["unread"]


def test_all_missing_keys_are_named_and_options_take_precedence(take):
    bare = {name: value for name, value in MANUAL.items() if name not in ("kp", "kd", "control_step")}
    assert rejection(take, "manual", bare).endswith("kp, kd, control_step are missing; they must be given")
    assert take("manual", bare, kp=25.0, kd=0.5, control_step=0.02) == take("manual", MANUAL)
    gym = GYM.replace("stiffness", "stifness").replace("damping", "dmping")
    message = rejection(take, "legged_gym", gym)
    assert "control.stiffness (did you mean stifness?), control.damping (did you mean dmping?) are missing" in message
    specification = take("legged_gym", gym, kp=30.0, kd=1.0, control_step=0.01)
    assert (specification.kp, specification.kd, specification.control_step) == (30.0, 1.0, 0.01)


def test_a_range_without_zero_is_rejected_unless_overridden(take):
    ranges = "    class commands:\n        class ranges:\n            lin_vel_x = [0.3, 0.8]\n"
    message = rejection(take, "legged_gym", GYM + ranges)
    assert "forward is [0.3, 0.8] m/s, without 0: standing was never trained" in message
    assert "give --forward 0 0.8 if the policy can stand" in message
    specification = take("legged_gym", GYM + ranges, forward=(0.0, 0.8))
    assert specification.forward == (0.0, 0.8)
    assert specification.notes["stand"] == "trained at forward 0.3 to 0.8 m/s: standing was never trained"
    table = MANUAL | {"forward": [0.3, 0.8]}
    assert "give --forward 0 0.8 if the policy can stand" in rejection(take, "manual", table)
    specification = take("manual", table, forward=(0.0, 0.8))
    assert specification.forward == (0.0, 0.8)
    assert specification.notes["stand"] == "trained at forward 0.3 to 0.8 m/s: standing was never trained"
    message = rejection(take, "legged_gym", GYM, forward=(0.4, 1.0))
    assert message.startswith("--forward is 0.4 to 1; it must go from 0 or less to 0 or more")


def test_notes_are_stored_in_the_policy(go2, tmp_path):
    (tmp_path / "policy.onnx").write_bytes(perceptron(45))
    (tmp_path / "config.py").write_text(GYM + "        use_filter = True\n")
    made = adopt(tmp_path / "policy.onnx", "legged_gym", go2, "x")
    notes = PolicyRuntime.parse(made.data).contract.figures["adopted"]["notes"]
    assert "use_filter" in notes["unread"]


def test_unusual_gravity_is_noted(take):
    def noted(scale: float) -> str:
        terms = [{**term, "scale": scale} if term["term"] == "gravity" else term for term in MANUAL["observations"]]
        return take("manual", {**MANUAL, "observations": terms}).notes.get("gravity", "")

    assert noted(1.0) == ""
    assert noted(9.81) == "gravity: its length is 9.81, usually 1"
    assert "its sign is opposite" in noted(-9.81)


def test_constant_inputs_are_noted(take):
    terms = [{"term": "constant", "values": [0, 0, 0]}, *MANUAL["observations"][1:]]
    note = take("manual", {**MANUAL, "observations": terms}).notes["constants"]
    assert note.startswith("3 of 45 inputs of the network are constants; if one of them changes by 1, the targets")
    muted = [{"term": "angular_velocity", "scale": 0.0}, *MANUAL["observations"][1:]]
    assert take("manual", {**MANUAL, "observations": muted}).notes["constants"].startswith("3 of 45 inputs")


def flat(**changes) -> dict:
    """Return a flat table of rl_sar before version 3."""
    (table,) = yaml.safe_load((DATA / "robot_lab" / "config.yaml").read_text()).values()
    table = {key: value for key, value in table.items() if key not in ("joint_mapping", "wheel_indices")}
    return {**table, "framework": "isaacgym", "rows": 4, "cols": 3, "dt": 0.005, "decimation": 4, **changes}


def test_a_flat_table_of_rl_sar_is_read(take, go2):
    specification = take("rl_sar", flat())
    assert specification.joints == go2.motor_names
    assert "the robot's is assumed, FR_hip_joint" in specification.notes["joints"]
    controllers = [name.replace("joint", "controller") for name in (*go2.motor_names[3:6], *go2.motor_names[:3])]
    controllers += [name.replace("joint", "controller") for name in go2.motor_names[6:]]
    named = take("rl_sar", flat(joint_controller_names=controllers))
    assert named.joints == (*go2.motor_names[3:6], *go2.motor_names[:3], *go2.motor_names[6:])
    message = rejection(take, "rl_sar", flat(dt=None))
    assert "rl_sar's format before version 3; dt is missing; it must be given (--control-step replaces it)" in message
    assert take("rl_sar", flat(dt=None), control_step=0.02).control_step == 0.02


def test_isaacsim_lists_are_transposed_unless_the_file_contradicts(take, go2):
    pose = np.tile([0.1, 0.8, -1.5], 4).tolist()
    specification = take("rl_sar", flat(framework="isaacsim", default_dof_pos=pose))
    assert specification.joints[:5] == (*go2.motor_names[::3], go2.motor_names[1])
    assert specification.default_pose[:5] == (0.1, 0.1, 0.1, 0.1, 0.8)
    reduced = flat(framework="isaacsim", hip_scale_reduction=0.5, hip_scale_reduction_indices=[0, 3, 6, 9])
    by_leg = take("rl_sar", {**reduced, "action_scale": 0.25})
    assert by_leg.joints == go2.motor_names
    assert by_leg.action_scale == (0.125, 0.25, 0.25) * 4
    assert "although framework is isaacsim" in by_leg.notes["joints"]


def test_hip_reduction_of_version_3_equals_a_reduced_action_scale(take):
    (table,) = yaml.safe_load((DATA / "robot_lab" / "config.yaml").read_text()).values()
    table |= {"dt": 0.005, "decimation": 4}
    reduced = {"action_scale": [0.25] * 12, "hip_scale_reduction": 0.5, "hip_scale_reduction_indices": [0, 3, 6, 9]}
    mine, theirs = take("rl_sar", {"go2/mine": {**table, **reduced}}), take("rl_sar", {"go2/mine": table})
    assert mine.action_scale == theirs.action_scale == (0.125, 0.25, 0.25) * 4
    message = rejection(take, "rl_sar", {"go2/mine": {**table, **reduced, "hip_scale_reduction_indices": [12]}})
    assert "hip_scale_reduction_indices are [12]; there are 12 joints" in message


def test_a_network_with_another_width_is_rejected_with_its_width(take):
    message = rejection(take, "manual", MANUAL, 48)
    assert "the network takes 48 numbers; the observations are 45: angular_velocity 3 x 1" in message
    assert message.endswith("3 more could be the speed of the base (term base_velocity)")


def test_folders_of_unitree_rl_lab_are_searched(go2, tmp_path):
    for name in ("exported", "params"):
        (tmp_path / name).mkdir()
    network = tmp_path / "exported" / "policy.onnx"
    network.write_bytes(perceptron(175))
    with pytest.raises(SurefootError, match=r"has no deploy.yaml next to it, nor in params next to its folder"):
        adopt(network, "unitree_rl_lab", go2, "x")
    (tmp_path / "params" / "deploy.yaml").write_text(yaml.safe_dump(DEPLOY))
    assert adopt(network, "unitree_rl_lab", go2, "x").specification.control_step == 0.02
