"""What the names of columns say: units anywhere in them, quantities that are none of a channel's, and drives."""

import mujoco
import pytest

from bayessim_mjx.logs import units
from bayessim_mjx.logs.names import mismatch
from bayessim_mjx.logs.proposal import propose

MODEL = mujoco.MjModel.from_xml_string("""
<mujoco><worldbody>
  <body><joint name="knee"/><geom size=".1"/></body><body><joint name="pan"/><geom size=".1"/></body>
  <body><joint name="wheel"/><geom size=".1"/></body>
</worldbody><actuator><motor name="m_knee" joint="knee"/><position name="pan" joint="pan" kp="3"/>
<velocity name="wheel" joint="wheel" kv="2"/></actuator></mujoco>""")


@pytest.mark.parametrize(
    ("name", "unit"),
    [
        ("kneePosDeg", "deg"), ("KneeDegrees", "deg"), ("knee_deg_filtered", "deg"), ("deg_knee", "deg"),
        ("knee [deg] (raw)", "deg"), ("knee_raw", "counts"), ("TimeUS", "us"), ("timeMs", "ms"), ("knee_mdeg", "mdeg"),
        ("knee_rpm_left", "rpm"), ("steps_knee", None), ("Knee", None), ("mass", None), ("q[0]", None),
    ],
)  # fmt: skip
def test_a_unit_is_found_where_a_word_means_nothing_else(name: str, unit: str | None) -> None:
    assert units.of_name(name) == unit


@pytest.mark.parametrize(
    "column", ["knee_temperature", "temp_knee", "knee_pos_error", "knee_acceleration", "knee_status", "knee_limit_max"]
)
def test_another_quantity_is_no_channel(column: str) -> None:
    assert not propose(["t", column], MODEL).blocks().keys() & {"qpos", "qvel", "ctrl", "streams"}


def test_an_unknown_word_behind_a_joint_is_asked_about() -> None:
    found = propose(["t", "knee_frobnication"], MODEL)
    assert not found.qpos and any("knee_frobnication" in q and "which quantity" in q for q in found.questions)
    assert propose(["t", "robot/leg/knee", "knee_filtered_2"], MODEL).questions  # two for one channel
    assert propose(["t", "robot/leg/knee"], MODEL).qpos == {"knee": "robot/leg/knee"}


@pytest.mark.parametrize(
    ("column", "drive", "right"),
    [
        ("knee_torque_cmd", "m_knee", True), ("knee_cmd", "m_knee", True), ("knee_target_pos", "m_knee", False),
        ("pan_target_pos", "pan", True), ("pan_cmd_vel", "pan", False), ("pan_target_deg", "pan", True),
        ("wheel_cmd_vel", "wheel", True), ("wheel_goal_position", "wheel", False), ("pan_torque_cmd", "pan", False),
        ("knee_current_cmd", "m_knee", False), ("knee_current_cmd_mA", "m_knee", True),
    ],
)  # fmt: skip
def test_a_command_is_what_its_drive_takes(column: str, drive: str, right: bool) -> None:
    assert (mismatch(column, drive, MODEL) == "") is right
    assert (propose(["t", column], MODEL).ctrl != {}) is right


def test_of_two_commands_the_drives_own_is_taken() -> None:
    found = propose(["t", "pan_target_pos", "pan_target_vel"], MODEL)
    assert found.ctrl == {"pan": "pan_target_pos"} and not found.questions
