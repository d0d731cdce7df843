"""What a diagnosis writes for plain MuJoCo moves as its corrected simulator does, wherever the model's files lie."""

import os
from pathlib import Path

import mujoco
import numpy as np
import pytest

from bayessim_mjx import effects as library
from bayessim_mjx import urdf
from bayessim_mjx.diagnosis.fitting.robot import of_file, robot_of
from bayessim_mjx.diagnosis.summary import files
from bayessim_mjx.effects.effect import in_order
from bayessim_mjx.rollout import replay
from tests.diagnosis.handwritten import diagnosis

MOTORS = '<motor name="a" joint="shoulder" gear="3"/><motor name="b" joint="elbow"/>'
SERVOS = '<position name="a" joint="shoulder" kp="20" {0}/><position name="b" joint="elbow" kp="10" {0}/>'
FORCES = {  # effects with a native form, at values that change the motion by several hundredths of a radian
    "actuator_bias": {"bias": 0.5},
    "actuator_gain": {"gain": 0.7},
    "actuator_lag": {"time_constant": 0.06},
    "actuator_saturation": {"inverse_limit": 1.1},
    "servo_damping": {"factor": 2.0},
    "servo_stiffness": {"factor": 0.5},
    "armature": {"inertia": 0.05},
    "cable_tension": {"forward": 2.0, "backward": 1.0, "taut": 0.1},
    "coulomb_friction": {"level": 0.4},
    "joint_spring": {"stiffness": 1.5, "cubic": 0.0, "rest": 0.3},
    "viscous_friction": {"damping": 0.3},
    "inertial_parameters": {"com_x": 0.03, "com_y": 0.01, "com_z": 0.02, "inertia": 1.3},
    "payload": {"mass": 0.4, "com_x": 0.08, "com_y": 0.02, "com_z": 0.03},
    "gravity_compensation": {"share": 0.4},
    "gravity_tilt": {"roll": 0.05, "pitch": 0.1},
}
# Of an effect's change of the motion (positions over 0.6 s), with the largest measured on the robots below. The same
# equations in single and double precision: 1e-5, allowed 2e-3.
# RK4: our viscous friction is that at the end of a timestep: 0.0057. Dry friction is exact here, but in MuJoCo a soft
# constraint (two timesteps), which the model's own friction shares and joint limits meet: 0.034. A lag is read at the
# start of each timestep in MuJoCo, here it is the mean over it, half a timestep earlier: 0.041.
SHARES = {"coulomb_friction": 0.05, "actuator_lag": 0.06}
ALLOWED = {"rk4": 1e-2}
SAME = 2e-3
DT, STEPS = 0.01, 60


def model(actuators, option="", compiler="", joints=("", ""), before="", after="", lower="", geom='contype="0"'):
    """An arm of two links in the vertical plane."""
    return f"""<mujoco>{compiler}<option timestep="0.002" {option}/>{before}<worldbody>
      <body name="upper" pos="0 0 1"><joint name="shoulder" axis="0 1 0" damping=".3" {joints[0]}/>
        <geom type="capsule" fromto="0 0 0 .3 0 0" size=".03" mass="1" conaffinity="0" {geom}/>
        <body name="lower" pos=".3 0 0" {lower}><joint name="elbow" axis="0 1 0" damping=".2" {joints[1]}/>
          <geom type="capsule" fromto="0 0 0 .25 0 0" size=".025" mass=".6" conaffinity="0" {geom}/>
          <body name="flange" pos=".25 0 0"><geom size=".02" mass=".1" conaffinity="0" {geom}/></body></body></body>
      </worldbody><actuator>{actuators}</actuator>{after}</mujoco>"""


FIXED = """<tendon><fixed name="t"><joint joint="shoulder" coef="1"/><joint joint="elbow" coef="-.5"/></fixed>
  <fixed name="u" stiffness="1"><joint joint="elbow" coef="1.5"/></fixed></tendon>"""
CLASSES = """<default><joint armature=".05" frictionloss=".1"/><position kp="10" dampratio="1" forcerange="-20 20"/>
  <default class="big"><position kp="30"/></default></default>"""
SAME_JOINT = '<motor name="c" joint="shoulder" gear="-2" forcerange="-1 1"/>'
IMPLICIT = 'integrator="implicitfast"'
ROBOTS = {
    "motors": model(MOTORS),
    "rk4": model(MOTORS, 'integrator="RK4"'),
    "servos": model(SERVOS.format('kv="1" forcerange="-15 15"'), IMPLICIT),
    "dampratio": model(SERVOS.format('dampratio=".7"'), IMPLICIT),
    "inheritrange": model(SERVOS.format('kv="1" inheritrange=".9"'), joints=['range="-90 90"'] * 2),
    "timeconst": model(SERVOS.format('kv="1" timeconst=".05"'), IMPLICIT),
    "classes": model('<position class="big" name="a" joint="shoulder"/><position name="b" joint="elbow"/>', IMPLICIT,
                     before=CLASSES),
    "two on a joint": model(MOTORS + SAME_JOINT),
    "tendons": model('<motor name="a" tendon="t"/><position name="b" tendon="u" kp="5" kv=".4"/>', after=FIXED),
    "gravcomp": model(MOTORS, lower='gravcomp=".5"', joints=('actuatorgravcomp="true"', "")),
    "no autolimits": model(SERVOS.format('kv="1" forcerange="-2 2" forcelimited="true" ctrllimited="false"'),
                           compiler='<compiler autolimits="false"/>'),
    "fusestatic": model(MOTORS, compiler='<compiler fusestatic="true"/>'),
    "settotalmass": model(MOTORS, compiler='<compiler settotalmass="3"/>'),
    "balanceinertia": model(MOTORS, compiler='<compiler balanceinertia="true" boundmass=".05" boundinertia=".002"/>'),
    "inertiafromgeom": model(MOTORS, compiler='<compiler inertiafromgeom="true"/>'),
    "degrees": model(MOTORS, joints=('range="-120 120" ref="10"', 'ref="20"')),
    "keyframe": model(SERVOS.format('kv="1"'), after='<keyframe><key qpos=".1 .2" ctrl=".1 .3"/></keyframe>'),
}  # fmt: skip


def commands(nu):
    t = DT * np.arange(STEPS)
    return np.stack([np.sin(2 * np.pi * (1.1 + 0.7 * i) * t + i) * 1.3 for i in range(nu)], 1)


def by_mujoco(model, qpos, lagging=()):
    """`[STEPS, nq]`; an actuator's lag starts at its first command, where MuJoCo's own starts at 0."""
    data, out = mujoco.MjData(model), []
    data.qpos[:] = qpos
    for i in lagging:
        data.act[model.actuator_actadr[i]] = np.clip(commands(model.nu)[0, i], *_range(model, i))
    for row in commands(model.nu):
        data.ctrl[:] = row
        mujoco.mj_step(model, data, round(DT / model.opt.timestep))
        out.append(data.qpos.copy())
    return np.array(out)


def _range(model, i):
    return model.actuator_ctrlrange[i] if model.actuator_ctrllimited[i] else (-np.inf, np.inf)


def stack(mj, values):
    """Effects at all their places in the model, those that it carries."""
    out = []
    for name, own in values.items():
        kind = library.load(name)
        count = {"actuator": mj.nu, "joint": mj.njnt}.get(kind.kind, 0)
        named = tuple(getattr(mj, kind.kind)(i).name for i in range(count) if kind.carries(mj, i))
        where = {"world": "world", "body": "lower"}.get(kind.kind, named)
        if where:
            out.append((library.make(name, where=where), own))
    return sorted(out, key=lambda pair: in_order([e for e, _ in out]).index(pair[0]))


def moved(robot, effects, values, rows, start):
    """`[rows, STEPS, nq]`, rows: which of the effects act."""
    physics = robot.physics(DT, effects)
    thetas = np.tile(physics.neutral, (len(rows), 1))
    for theta, acting in zip(thetas, rows, strict=True):
        for k in acting:
            for block in physics.blocks_of(effects[k]):
                theta[block.slice] = [values[k][q.name] for q in block.quantities]
    nu, n = robot.mj_model.nu, len(rows)
    command = np.tile(commands(nu), (n, 1, 1))
    states = np.tile(start, (n, 1)), np.zeros((n, robot.mj_model.nv))
    return np.asarray(replay(physics, *states, command, thetas)["qpos"])[:, 1:]


@pytest.mark.slow
@pytest.mark.parametrize("name", [pytest.param(n, marks=pytest.mark.ci) if n == "dampratio" else n for n in ROBOTS])
def test_the_written_model_moves_as_the_corrected_simulator(name, tmp_path):
    (tmp_path / "robot.xml").write_text(ROBOTS[name])
    robot = of_file(tmp_path / "robot.xml")
    mj, start = robot.mj_model, np.full(robot.mj_model.nq, 0.2)
    found = stack(mj, FORCES)
    effects, values = [e for e, _ in found], [v for _, v in found]
    every = moved(robot, effects, values, [(), *((k,) for k in range(len(found)))], start)
    nominal, tried = every[0], 0
    assert np.abs(nominal - by_mujoco(mj, start)).max() < 1e-5
    for effect, own, ours in zip(effects, values, every[1:], strict=True):
        places = [(effect.name, place, {q: (x, 0.01) for q, x in own.items()}) for place in effect.places()]
        left_out = files.write_outputs(diagnosis(places), robot, tmp_path)
        if left_out:  # a servo with an activation has no second one
            assert (name, effect.name) in {("timeconst", "actuator_lag")}
            continue
        there = mujoco.MjModel.from_xml_path(str(tmp_path / files.MODEL))
        lagging = range(mj.nu) if effect.name == "actuator_lag" else ()
        change = np.abs(ours - nominal).max()
        away = np.abs(by_mujoco(there, start, lagging) - ours).max()
        share = SHARES.get(effect.name, ALLOWED.get(name, SAME))
        assert change > 0.01 and away < share * change + 2e-5, (effect.name, change, away)
        tried += 1
    assert tried >= 11


@pytest.mark.slow
@pytest.mark.ci
def test_several_effects_at_once_and_recalibrated_masses_are_all_written(tmp_path):
    (tmp_path / "robot.xml").write_text(ROBOTS["dampratio"])
    robot = of_file(tmp_path / "robot.xml")
    names = ("actuator_gain", "servo_stiffness", "armature", "viscous_friction", "inertial_parameters", "payload")
    found = stack(robot.mj_model, {n: FORCES[n] for n in names})
    places = [(e.name, w, {q: (x, 0.01) for q, x in v.items()}) for e, v in found for w in e.places()]
    made, start = diagnosis(places, {"lower_mass_mult": (1.2, 0.01)}), np.full(2, 0.2)
    physics = made.apply(robot.physics(DT))
    state = start[None], np.zeros((1, 2)), commands(2)[None], physics.space.nominal[None]
    ours = np.asarray(replay(physics, *state)["qpos"])[0, 1:]
    assert files.write_outputs(made, robot, tmp_path) == []
    there = mujoco.MjModel.from_xml_path(str(tmp_path / files.MODEL))
    assert np.abs(by_mujoco(robot.mj_model, start) - ours).max() > 0.1
    assert np.abs(by_mujoco(there, start) - ours).max() < 2e-4


TETRAHEDRON = "v 0 0 0\nv .1 0 0\nv 0 .1 0\nv 0 0 .1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"
MESH = '<asset><mesh name="m" file="m.obj"/></asset>'
LINK = '<body name="link"><joint name="j"/><geom type="mesh" mesh="{}" contype="0" conaffinity="0"/></body>'
REST = '<worldbody>{}</worldbody><actuator><motor name="d" joint="j"/></actuator></mujoco>'
PART = f'<mujoco model="part"><compiler angle="radian"/>{MESH}<worldbody>{LINK.format("m")}</worldbody></mujoco>'
ATTACHED = '<asset><model name="part" file="sub/part.xml"/></asset>'
LAYOUTS = {
    "beside": ({"m.obj": TETRAHEDRON}, f"<mujoco>{MESH}" + REST.format(LINK.format("m"))),
    "meshdir": ({"a/m.obj": TETRAHEDRON}, f'<mujoco><compiler meshdir="a"/>{MESH}' + REST.format(LINK.format("m"))),
    "above": ({"../a/m.obj": TETRAHEDRON},
              f'<mujoco><compiler meshdir="../a"/>{MESH}' + REST.format(LINK.format("m"))),
    "include": ({"b/m.obj": TETRAHEDRON, "c/i.xml": f"<mujocoinclude>{MESH}</mujocoinclude>"},
                '<mujoco><compiler meshdir="b"/><include file="c/i.xml"/>' + REST.format(LINK.format("m"))),
    "attached": ({"sub/m.obj": TETRAHEDRON, "sub/part.xml": PART},
                 f"<mujoco>{ATTACHED}" + REST.format('<frame><attach model="part" body="link" prefix=""/></frame>')),
    "spaces": ({"my meshes/m.obj": TETRAHEDRON},
               f'<mujoco><compiler meshdir="my meshes"/>{MESH}' + REST.format(LINK.format("m"))),
}  # fmt: skip


def put(folder, files):
    for name, text in files.items():
        path = Path(os.path.normpath(folder / name))
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)


@pytest.mark.parametrize("layout", LAYOUTS)
def test_the_written_model_finds_its_meshes_from_another_folder(layout, tmp_path, monkeypatch):
    beside, text = LAYOUTS[layout]
    put(tmp_path / "robots", beside | {"robot.xml": text})
    (tmp_path / "out").mkdir()
    monkeypatch.chdir(tmp_path / "robots")
    robot = of_file("robot.xml")  # from where the user stands
    assert files.write_outputs(diagnosis([]), robot, tmp_path / "out") == []
    monkeypatch.chdir(tmp_path / "out")
    there = mujoco.MjModel.from_xml_path(files.MODEL)
    assert there.nmesh == 1 and np.array_equal(there.body_inertia, robot.mj_model.body_inertia)


def test_a_model_that_does_not_load_again_is_said_and_ends_nothing(tmp_path):
    spec = mujoco.MjSpec.from_string(LAYOUTS["beside"][1], assets={"m.obj": TETRAHEDRON.encode()})
    (said,) = files.write_outputs(diagnosis([]), robot_of(spec), tmp_path)  # meshes of no file
    assert said.startswith("model_with_effects.xml does not load, use effects.yaml: ") and "m.obj" in said


INERTIAL = """<inertial><origin xyz="0 .02 -.1" rpy=".3 -.2 .5"/><mass value=".5"/>
  <inertia ixx=".002" iyy=".003" izz=".0025" ixy=".0001" ixz="0" iyz="-.0002"/></inertial>"""
URDF = f"""<robot name="r"><!-- of the maker --><link name="base"/>
  <link name="arm">{INERTIAL}<collision><geometry><mesh filename="meshes/m.obj"/></geometry></collision></link>
  <link name="tool">{INERTIAL}</link><link name="hand">{INERTIAL}</link>
  <joint name="elbow" type="revolute"><parent link="base"/><child link="arm"/><axis xyz="0 1 0"/>
    <limit lower="-2" upper="2" effort="30" velocity="6"/><dynamics damping=".05" friction=".02"/></joint>
  <joint name="bolt" type="fixed"><parent link="arm"/><child link="tool"/><origin xyz="0 0 -.2" rpy="0 .4 0"/></joint>
  <joint name="wrist" type="revolute"><parent link="arm"/><child link="hand"/><axis xyz="0 1 0"/>
    <limit lower="-2" upper="2" effort="10" velocity="6"/></joint></robot>"""


def test_a_urdf_gives_a_urdf_with_friction_damping_and_inertias(tmp_path):
    put(tmp_path / "robot", {"meshes/m.obj": TETRAHEDRON, "r.urdf": URDF})
    (tmp_path / "out").mkdir()
    robot = of_file(tmp_path / "robot" / "r.urdf", drive="torque")
    effects = [
        ("coulomb_friction", "elbow", {"level": (0.4, 0.01)}),
        ("viscous_friction", "wrist", {"damping": (0.3, 0.01)}),
        ("payload", "hand", {"mass": (0.7, 0.01), "com_x": (0.05, 0.01), "com_y": (0, 0.01), "com_z": (-0.1, 0.01)}),
        ("armature", "elbow", {"inertia": (0.1, 0.01)}),
    ]
    found = diagnosis(effects, {"arm_mass_mult": (1.3, 0.01)})
    (said,) = files.write_outputs(found, robot, tmp_path / "out")
    assert said.startswith("model_with_effects.urdf leaves out armature at elbow: a URDF has friction")
    there, plain = urdf.read(tmp_path / "out" / files.URDF), of_file(tmp_path / "robot" / "r.urdf", drive="torque")
    urdf.drive(there, "torque")
    there, full = there.compile(), mujoco.MjModel.from_xml_path(str(tmp_path / "out" / files.MODEL))
    assert "<!-- of the maker -->" in (tmp_path / "out" / files.URDF).read_text()
    assert there.nmesh == plain.mj_model.nmesh == 1
    for field in ("dof_damping", "dof_frictionloss", "body_mass", "body_ipos"):
        np.testing.assert_allclose(getattr(there, field), getattr(full, field), rtol=1e-6, atol=1e-8)
    assert there.dof_frictionloss == pytest.approx([0.42, 0]) and there.dof_damping == pytest.approx([0.05, 0.3])
    full.dof_armature[:] = 0
    masses = []
    for model in (there, full):
        data, mass = mujoco.MjData(model), np.zeros((2, 2))
        data.qpos[:] = 0.3, -0.7
        mujoco.mj_forward(model, data)
        mujoco.mj_fullM(model, data, mass)
        masses.append(mass)
    np.testing.assert_allclose(*masses, rtol=1e-6)


def test_an_mjcf_gives_no_urdf(tmp_path):
    put(tmp_path, {"robot.xml": ROBOTS["motors"], files.URDF: "of an earlier diagnosis"})
    files.write_outputs(diagnosis([]), of_file(tmp_path / "robot.xml"), tmp_path)
    assert not (tmp_path / files.URDF).exists()
