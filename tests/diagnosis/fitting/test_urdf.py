"""URDF: limits, friction and mimic joints are MuJoCo's; drives and packages are ours."""

import mujoco
import numpy as np
import pytest

from bayessim_mjx import urdf
from bayessim_mjx.diagnosis.fitting.robot import of_file
from bayessim_mjx.errors import UserError

LINK = """<link name="{0}"><inertial><origin xyz="0 0 -0.1"/><mass value="0.5"/>
<inertia ixx="0.002" iyy="0.002" izz="0.0002" ixy="0" ixz="0" iyz="0"/></inertial>{1}</link>"""
JOINT = """<joint name="{0}" type="revolute"><parent link="{1}"/><child link="{2}"/><axis xyz="0 1 0"/>
<limit lower="-2" upper="2" effort="3" velocity="6"/><dynamics damping="0.05" friction="0.02"/>{3}</joint>"""
TETRAHEDRON = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"


def robot(folder, mesh="", file="robot.urdf"):
    shape = f'<collision><geometry><mesh filename="{mesh}"/></geometry></collision>' if mesh else ""
    parts = [
        LINK.format("arm", shape), LINK.format("hand", ""), JOINT.format("elbow", "base", "arm", ""),
        JOINT.format("finger", "arm", "hand", '<mimic joint="elbow" multiplier="2" offset=".1"/>'),
    ]  # fmt: skip
    path = folder / file
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(f'<robot name="r"><link name="base"/>{"".join(parts)}</robot>')
    return path


def test_without_a_drive_the_error_names_the_way_on(tmp_path):
    with pytest.raises(UserError, match=r"no actuator, .*allowed: --drive torque .* --drive position:KP,KV"):
        of_file(robot(tmp_path))


@pytest.mark.parametrize(
    ("drive", "gain", "bias"),
    [("torque", 1, (0, 0, 0)), ("position:80,2", 80, (0, -80, -2)), ("velocity:3", 3, (0, 0, -3))],
)
def test_a_drive_acts_at_each_joint_that_moves_on_its_own(tmp_path, drive, gain, bias):
    model = of_file(robot(tmp_path), drive=drive).mj_model
    assert [model.actuator(i).name for i in range(model.nu)] == ["elbow"]  # the finger follows it
    assert model.actuator_gainprm[0, 0] == gain and np.array_equal(model.actuator_biasprm[0, :3], bias)
    assert np.array_equal(model.jnt_actfrcrange[0], [-3, 3]) and model.neq == 1
    assert model.dof_damping[0] == 0.05 and model.dof_frictionloss[0] == 0.02


def test_drives_by_joint(tmp_path):
    (tmp_path / "drives.yaml").write_text("el*: position:40\n")
    model = of_file(robot(tmp_path), drive=str(tmp_path / "drives.yaml")).mj_model
    assert model.actuator_biasprm[0, 1] == -40


@pytest.mark.parametrize("drive", ["servo", "position", "position:a", "position:-1", "torque:3", "velocity:1,2"])
def test_a_wrong_drive_is_refused(tmp_path, drive):
    with pytest.raises(UserError, match=r"--drive .*: no such drive \(joint elbow\); allowed: torque, position:KP"):
        of_file(robot(tmp_path), drive=drive)


def test_an_unknown_joint_is_refused(tmp_path):
    (tmp_path / "drives.yaml").write_text("elbo: torque\n")
    with pytest.raises(UserError, match="no joint 'elbo' that moves on its own; did you mean elbow"):
        of_file(robot(tmp_path), drive=str(tmp_path / "drives.yaml"))


def test_actuators_that_are_there_stay(tmp_path):
    (tmp_path / "a.xml").write_text(
        '<mujoco><worldbody><body><joint name="h"/><geom size=".1"/></body></worldbody>'
        '<actuator><motor name="m" joint="h"/></actuator></mujoco>'
    )
    with pytest.raises(UserError, match=r"--drive torque: the model has actuators already \(m\)"):
        of_file(tmp_path / "a.xml", drive="torque")


def test_packages_are_found_above_the_file_or_where_they_are_said_to_be(tmp_path):
    uri = "package://my_robot/meshes/arm.obj"
    inside = robot(tmp_path, uri, "my_robot/urdf/robot.urdf")
    mesh = tmp_path / "my_robot" / "meshes" / "arm.obj"
    mesh.parent.mkdir()
    mesh.write_text(TETRAHEDRON)
    elsewhere = robot(tmp_path / "other", uri)
    assert of_file(inside, drive="torque").mj_model.nmesh == 1
    for packages in ([f"my_robot={tmp_path / 'my_robot'}"], [str(tmp_path)]):
        assert of_file(elsewhere, drive="torque", packages=packages).mj_model.nmesh == 1
    alone = robot(tmp_path / "far", "package://unknown/arm.obj")
    with pytest.raises(
        UserError, match=r"package://unknown/arm\.obj: no such file; allowed: --packages unknown=FOLDER"
    ):
        of_file(alone, drive="torque")
    with pytest.raises(UserError, match="--packages a=/nowhere: no folder /nowhere"):
        urdf.read(alone, ["a=/nowhere"])


def test_what_is_read_compiles_again(tmp_path):
    found = of_file(robot(tmp_path), drive="torque")
    assert isinstance(found.spec().compile(), mujoco.MjModel)
