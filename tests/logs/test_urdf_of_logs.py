"""Logs of a robot whose model is a URDF without actuators."""

import math

import mujoco
import pytest

from bayessim_mjx import import_logs
from bayessim_mjx.diagnosis.fitting import robot
from bayessim_mjx.errors import UserError

URDF = """<robot name="r"><link name="base"/>
<link name="arm"><inertial><origin xyz="0 0 -0.1"/><mass value="0.5"/>
<inertia ixx="0.002" iyy="0.002" izz="0.0002" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="elbow" type="revolute"><parent link="base"/><child link="arm"/><axis xyz="0 1 0"/>
<limit lower="-2" upper="2" effort="3" velocity="6"/></joint></robot>"""


def test_a_check_names_drives_and_carries_them_on(tmp_path, capsys):
    model, logs = tmp_path / "r.urdf", tmp_path / "logs"
    model.write_text(URDF)
    logs.mkdir()
    arm, rows = mujoco.MjModel.from_xml_string(URDF), ""
    data = mujoco.MjData(arm)
    for k in range(200):
        data.qfrc_applied[0] = 0.2 * math.sin(0.1 * k) + 0.1 * math.sin(0.23 * k) - 0.02 * float(data.qvel[0])
        rows += f"{0.02 * k:.2f},{data.qfrc_applied[0]:.6f},{data.qpos[0]:.6f}\n"
        mujoco.mj_step(arm, data, 10)
    (logs / "a.csv").write_text("time,ctrl:elbow,qpos:elbow\n" + rows)
    given = ["check", str(logs), "--model", str(model)]
    assert import_logs.main(given) == 2
    assert "allowed: --drive torque" in capsys.readouterr().err
    assert import_logs.main([*given, "--drive", "torque"]) == 0
    assert f"--model {model} --drive torque --data {logs}" in capsys.readouterr().out


def test_a_folder_in_the_place_of_a_model_is_said(tmp_path):
    (tmp_path / "logs").mkdir()
    with pytest.raises(UserError, match="a folder; give the file in it"):
        robot.names_of(tmp_path / "logs")
