"""Payload, inertials, tilted gravity, forces from outside and a rocking base, against MuJoCo C with the same in it."""

import mujoco
import numpy as np
import pytest

from bayessim_mjx.effects import make
from bayessim_mjx.errors import UserError
from tests.effects.truths import edited, moved, physics, recovered, truth

ARM = """
<mujoco>
  <option timestep="{dt}"/>
  <worldbody>
    <body name="base" pos="0 0 .5">{mount}
      <body name="upper">
        <joint name="yaw" axis="0 0 1" damping="1" armature=".02"/>
        <geom type="box" pos=".15 .02 .05" euler="20 30 10" size=".2 .03 .05" mass="1.5" contype="0" conaffinity="0"/>
        <body name="fore" pos=".3 0 .1">
          <joint name="elbow" axis="0 1 0" damping="1" armature=".02"/>
          <geom type="box" pos=".15 0 .02" euler="10 0 40" size=".15 .02 .04" mass=".8" contype="0" conaffinity="0"/>
        </body>
      </body>
    </body>
  </worldbody>
  <actuator><motor joint="yaw"/><motor joint="elbow"/></actuator>
</mujoco>
"""
XML, FINE = (ARM.format(dt=dt, mount="") for dt in (0.002, 0.0002))
BODIES = ("upper", "fore")
T = 40
TIME = 0.02 * np.arange(T)
COMMAND = np.stack([3 * np.sin(7 * TIME), 2 + 3 * np.sin(11 * TIME + 1)], axis=1)
NAMES = ("payload", "inertial_parameters", "gravity_tilt", "external_force", "base_flexibility")
NEUTRAL = {
    "payload": [0.0] * 8,
    "inertial_parameters": [0.0, 0.0, 0.0, 1.0] * 2,
    "gravity_tilt": [0.0] * 2,
    "external_force": [0.0] * 8,
    "base_flexibility": [0, 10, 0.1, 0],
}
ROWS = 10


def stack():
    places = {"payload": BODIES, "inertial_parameters": BODIES, "external_force": BODIES}
    return [make(name, where=places.get(name, "world")) for name in NAMES]


WORLD = physics(XML, stack())


def theta(**active):
    return np.concatenate([active.get(name, NEUTRAL[name]) for name in NAMES])


def run(*thetas):
    """All of this file in one compiled program: always the same number of worlds."""
    full = np.array([*thetas, *[theta()] * (ROWS - len(thetas))])
    return moved(WORLD, full, COMMAND)[: len(thetas)]


def plain():
    return truth(mujoco.MjModel.from_xml_string(XML), COMMAND)


@pytest.mark.slow
def test_neutral_changes_no_bit_also_beside_another_effect():
    friction = make("coulomb_friction", where="elbow")
    alone = moved(physics(XML, [friction]), [[0.3]], COMMAND)
    beside = moved(physics(XML, [friction, *stack()]), [[0.3, *theta()]], COMMAND)
    assert np.ptp(alone[0, :, 1]) > 0.1
    np.testing.assert_array_equal(beside, alone)


@pytest.mark.slow
@pytest.mark.ci
def test_payload_is_a_point_mass_welded_on():
    """To 1e-4 rad, while it moves the arm by much more; in both places at once, at the body's own centre too."""
    own = {"upper": [0.4, 0.05, -0.1, 0.02], "fore": [0.7, -0.03, 0.08, 0.1]}
    keys = ("mass", "com_x", "com_y", "com_z")
    values = {place: dict(zip(keys, row, strict=True)) for place, row in own.items()}
    central = {"upper": [0, 0, 0, 0], "fore": [1.5, 0, 0, 0]}
    q = run(*(theta(payload=np.concatenate([v["upper"], v["fore"]])) for v in (own, central)))
    real = truth(edited(XML, make("payload", where=BODIES), values), COMMAND)
    np.testing.assert_allclose(q[0], real, atol=1e-4)
    assert np.abs(real - plain()).max() > 0.1
    values = {"fore": dict(mass=1.5, com_x=0, com_y=0, com_z=0)}
    np.testing.assert_allclose(q[1], truth(edited(XML, make("payload", where="fore"), values), COMMAND), atol=1e-4)


def test_a_payload_hangs_on_an_arm_whose_own_weight_is_carried():
    """`gravcomp` is made for the robot as it was delivered: MuJoCo carries no body that was added."""
    carried = XML.replace('<body name="upper">', '<body name="upper" gravcomp="1">').replace(
        '<body name="fore" ', '<body name="fore" gravcomp=".8" '
    )
    spec, place = mujoco.MjSpec.from_string(carried), np.array([-0.03, 0.08, 0.1])
    own = mujoco.MjModel.from_xml_string(carried).body("fore").ipos
    load = spec.body("fore").add_body(pos=own + place, mass=0.7, inertia=np.full(3, 1e-9), ipos=np.zeros(3))
    load.explicitinertial = True
    effect = make("payload", where="fore")
    real = truth(spec.compile(), COMMAND)
    (q,) = moved(physics(carried, [effect]), [[0.7, *place]], COMMAND)
    np.testing.assert_allclose(q, real, atol=2e-4)
    assert np.abs(real - truth(mujoco.MjModel.from_xml_string(carried), COMMAND)).max() > 0.1
    values = {"fore": dict(zip(("mass", "com_x", "com_y", "com_z"), (0.7, *place), strict=True))}
    np.testing.assert_allclose(truth(edited(carried, effect, values), COMMAND), real, atol=1e-6)


def heavy(own):
    """The compiled arm with other inertials, written into MuJoCo's own fields."""
    model = mujoco.MjModel.from_xml_string(XML)
    for name, (x, y, z, factor) in own.items():
        body = model.body(name).id
        model.body_ipos[body] += [x, y, z]
        model.body_inertia[body] *= factor
    mujoco.mj_setConst(model, mujoco.MjData(model))
    return model


@pytest.mark.slow
@pytest.mark.ci
def test_inertial_parameters_are_those_of_the_compiled_body():
    own = {"upper": [0.02, -0.03, 0.01, 1.3], "fore": [-0.01, 0.02, 0.03, 0.7]}
    real = truth(heavy(own), COMMAND)
    (q,) = run(theta(inertial_parameters=np.concatenate([own["upper"], own["fore"]])))
    np.testing.assert_allclose(q, real, atol=1e-4)
    assert np.abs(real - plain()).max() > 0.05
    effect, keys = make("inertial_parameters", where=BODIES), ("com_x", "com_y", "com_z", "inertia")
    written = edited(XML, effect, {place: dict(zip(keys, row, strict=True)) for place, row in own.items()})
    np.testing.assert_allclose(truth(written, COMMAND), real, atol=1e-6)


@pytest.mark.slow
@pytest.mark.ci
def test_gravity_tilt_is_a_robot_mounted_askew():
    """A robot turned by R under upright gravity moves as one under R^T g."""
    roll, pitch = 0.08, -0.06
    model = mujoco.MjModel.from_xml_string(XML)
    quats = [np.zeros(4) for _ in range(3)]
    mujoco.mju_axisAngle2Quat(quats[0], [0, 1, 0], pitch)
    mujoco.mju_axisAngle2Quat(quats[1], [1, 0, 0], roll)
    mujoco.mju_mulQuat(quats[2], quats[0], quats[1])
    model.body_quat[1] = quats[2]
    real = truth(model, COMMAND)
    (q,) = run(theta(gravity_tilt=[roll, pitch]))
    np.testing.assert_allclose(q, real, atol=1e-4)
    assert np.abs(real - plain()).max() > 0.02
    native = edited(XML, make("gravity_tilt", where="world"), {"world": {"roll": roll, "pitch": pitch}})
    np.testing.assert_allclose(truth(native, COMMAND), real, atol=1e-5)


@pytest.mark.parametrize("slowness", [0.0, 0.4])
@pytest.mark.slow
@pytest.mark.ci
def test_external_force_is_xfrc_applied(slowness):
    """Constant, and as wind: |F| |e - kappa v| (e - kappa v) with the body's own velocity."""
    force = np.array([3.0, -2.0, 4.0])

    def push(model, data):
        body = model.body("fore").id
        both = np.zeros(6)
        mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_BODY, body, both, 0)
        along = force / np.linalg.norm(force) - slowness * both[3:]
        data.xfrc_applied[body, :3] = np.linalg.norm(force) * np.linalg.norm(along) * along

    real = truth(mujoco.MjModel.from_xml_string(XML), COMMAND, push=push)
    (q,) = run(theta(external_force=[0] * 4 + [*force, slowness]))
    np.testing.assert_allclose(q, real, atol=1e-4)
    assert np.abs(real - plain()).max() > 0.1


def rocking(compliance, frequency, ratio, depth):
    """The arm by MuJoCo C, at a tenth of the timestep, on a base with two more hinges, which starts at rest."""
    inertia = 1 / (compliance * (2 * np.pi * frequency) ** 2)
    damping = 2 * ratio * np.sqrt(inertia / compliance)
    hinge = '<joint name="rock{0}" axis="{0}" pos="0 0 -{4}" stiffness="{1}" damping="{2}" armature="{3}"/>'
    joints = "".join(hinge.format(axis, 1 / compliance, damping, inertia, depth) for axis in ("0 1 0", "1 0 0"))
    light = '<inertial pos="0 0 0" mass="1e-6" diaginertia="1e-9 1e-9 1e-9"/>'
    model = mujoco.MjModel.from_xml_string(ARM.format(dt=0.0002, mount=joints + light))
    data = mujoco.MjData(model)
    start = np.zeros(4)
    for _ in range(20):  # the tilt at which the spring carries the weight
        data.qpos[:] = start
        mujoco.mj_forward(model, data)
        start[:2] = -data.qfrc_bias[:2] * compliance
    apart = truth(model, COMMAND, qpos=start)[:, 2:] - truth(mujoco.MjModel.from_xml_string(FINE), COMMAND)
    return plain() + apart  # without the error that the arm's own timestep makes with and without the base


@pytest.mark.parametrize(
    "base", [(0.004, 8.0, 0.1, 0.0), (0.002, 25.0, 0.05, 0.0), (0.01, 4.0, 0.3, 0.0), (0.004, 8.0, 0.1, 0.3)]
)
def test_base_flexibility_is_two_more_hinges(base):
    real = rocking(*base)
    (q,) = run(theta(base_flexibility=base))
    effect = np.abs(real - plain()).max()
    assert effect > 0.01
    assert np.abs(q - real).max() < 0.05 * effect + 5e-4


DOOR = """<body name="cabinet" pos="1 .3 .4"><geom size=".1" contype="0" conaffinity="0"/><body name="leaf">
<joint name="door" axis="0 1 0" damping=".3"/><geom pos=".2 0 .1" size=".1" mass="2" contype="0" conaffinity="0"/>
</body></body>"""


def test_what_stands_beside_the_robot_does_not_rock_with_it():
    """The arm moves as it does alone, and a door on a hinge as it does in MuJoCo C, where nothing rocks it."""
    beside = XML.replace("<worldbody>", f"<worldbody>{DOOR}")
    (q,) = moved(physics(beside, [make("base_flexibility", where="world")]), [[0.004, 8.0, 0.1, 0.3]], COMMAND)
    still = truth(mujoco.MjModel.from_xml_string(beside), COMMAND)
    np.testing.assert_allclose(q[:, 0], still[:, 0], atol=1e-4)
    real = rocking(0.004, 8.0, 0.1, 0.3)
    assert np.ptp(still[:, 0]) > 0.5 and np.abs(q[:, 1:] - real).max() < 0.05 * np.abs(real - plain()).max() + 5e-4


def test_stays_finite_and_tends_to_neutral():
    edges = [
        theta(payload=[10.0, 0.1, 0.1, 0.1, 10.0, -0.1, 0.1, -0.1]),
        theta(external_force=[30.0, -30.0, 30.0, 0.5] * 2),
        theta(base_flexibility=[0.01, 2.0, 0.01, 0.0]),
        theta(base_flexibility=[0.1, 30.0, 0.01, 1.0]),
        theta(payload=[1e-6, 0.1, 0.1, 0.1] * 2, external_force=[1e-5, 0, 0, 0.5] * 2),
        theta(gravity_tilt=[1e-7, -1e-7], base_flexibility=[1e-8, 30.0, 0.01, 0.5]),
    ]
    q = run(*edges, theta())
    assert np.isfinite(q).all()
    np.testing.assert_allclose(q[4:6], np.stack([q[-1]] * 2), atol=1e-4)


def pushed(force):
    def push(model, data):
        data.xfrc_applied[model.body("fore").id, :3] = force

    return truth(mujoco.MjModel.from_xml_string(XML), COMMAND, push=push)


def native(name, place, **values):
    return truth(edited(XML, make(name, where=place), {place: values}), COMMAND)


@pytest.mark.parametrize(
    ("name", "values", "columns", "real"),
    [
        ("payload", [0, 0, 0, 0, 0.3, 0.05, 0.0, 0.06], [4, 5, 7],
         lambda: native("payload", "fore", mass=0.3, com_x=0.05, com_y=0.0, com_z=0.06)),
        ("inertial_parameters", [0, 0, 0, 1, 0.02, 0, 0.03, 1], [4, 6],
         lambda: truth(heavy({"fore": [0.02, 0, 0.03, 1]}), COMMAND)),
        ("gravity_tilt", [0.03, -0.05], [0, 1], lambda: native("gravity_tilt", "world", roll=0.03, pitch=-0.05)),
        ("external_force", [0, 0, 0, 0, 2.0, -1.0, 1.5, 0.0], [4, 5, 6], lambda: pushed([2.0, -1.0, 1.5])),
        ("base_flexibility", [0.004, 8.0, 0.1, 0.2], [0], lambda: rocking(0.004, 8.0, 0.1, 0.2)),
    ],
)  # fmt: skip
def test_recovers_what_mujoco_was_given(name, values, columns, real):
    def simulate(points):
        own = np.tile(np.asarray(values, float), (len(points), 1))
        own[:, columns] = points
        return run(*(theta(**{name: row}) for row in own))

    wanted = np.asarray(values, float)[columns]
    found = recovered(simulate, real(), 0.3 * wanted, np.abs(wanted).max() * np.ones(len(columns)), ROWS)
    np.testing.assert_allclose(found, wanted, atol=0.04 * np.abs(wanted).max())


@pytest.mark.slow
@pytest.mark.ci
def test_two_places_are_two_single_effects():
    singles = [make(name, where=body) for name in ("payload", "external_force") for body in BODIES]
    load, push = [0.4, 0.05, -0.1, 0.02, 0.7, -0.03, 0.08, 0.1], [3.0, 0, 1.0, 0.2, 0, -2.0, 1.0, 0.1]
    apart = moved(physics(XML, singles), [[*load, *push]], COMMAND)
    np.testing.assert_allclose(run(theta(payload=load, external_force=push)), apart, atol=1e-5)


def test_refusals():
    ball = '<body name="ball"><joint name="float" type="free"/><geom size="1"/></body>'
    lone = f"<mujoco><worldbody>{ball}</worldbody></mujoco>"
    with pytest.raises(UserError, match="joint 'float' is free.*fixed to the world"):
        physics(lone, [make("base_flexibility", where="world")])
    with pytest.raises(UserError, match="ball.*simple"):
        physics(lone, [make("payload", where="ball")])
    with pytest.raises(UserError, match="ball.*simple"):
        physics(lone, [make("inertial_parameters", where="ball")])
    with pytest.raises(UserError, match="'base'"):
        physics(XML, [make("payload", where="base")])
