"""Elasticity and backlash against MuJoCo C with the motor as a body of its own, at a tenth of the timestep."""

import functools

import mujoco
import numpy as np
import pytest

from bayessim_mjx.effects import make
from bayessim_mjx.parameters import Parameter, ParameterSpace
from bayessim_mjx.physics import Physics
from tests.effects.truths import moved, physics, recovered, truth

LINK = """
      <joint name="{0}" axis="0 1 0" damping="{2}" armature="{1}"/>
      <geom type="capsule" fromto="0 0 0 0 0 -.3" size=".02" mass="1" contype="0" conaffinity="0"/>"""
ONE = f"""
<mujoco>
  <option timestep="{{dt}}" integrator="{{integrator}}"/>
  <worldbody><body>{LINK.format("link", "{armature}", 0.02)}</body></worldbody>
  <actuator>{{actuator}}</actuator>
</mujoco>
"""
TWO = f"""
<mujoco>
  <option timestep=".0002"/>
  <worldbody>
    <body>{LINK.format("link", 0, 0)}</body>
    <body><joint name="motor" axis="0 1 0" damping=".02"/><inertial pos="0 0 0" mass="1" diaginertia="1 .02 1"/></body>
  </worldbody>
  <tendon>
    <fixed {{between}}><joint joint="motor" coef="1"/><joint joint="link" coef="-1"/></fixed>
  </tendon>
  <actuator>{{actuator}}</actuator>
</mujoco>
"""
CHAIN = f"""
<mujoco>
  <option timestep="{{dt}}"/>
  <worldbody>
    <body>{LINK.format("a", "{a}", "{d}")}<body pos="0 0 -.3">{LINK.format("b", "{b}", "{d}")}</body></body>{{motors}}
  </worldbody>
  <tendon>{{springs}}</tendon>
  <actuator><motor joint="{{at}}a"/><motor joint="{{at}}b"/></actuator>
</mujoco>
"""
ROTOR = """
    <body>
      <joint name="motor{0}" axis="0 1 0" damping=".02"/><inertial pos="0 0 0" mass="1" diaginertia="1 {1} 1"/>
    </body>"""
SPRING = """
    <fixed stiffness="{1}" damping="{2}"><joint joint="motor{0}" coef="1"/><joint joint="{0}" coef="-1"/></fixed>"""
TORQUE, SERVO = '<motor joint="{0}"/>', '<position joint="{0}" kp="20" kv=".6"/>'
LIMITED = SERVO.replace("/>", ' forcerange="-2 2"/>')
ARMATURE, INERTIA = 0.02, 0.0315  # kg m^2: of motor and link
SERIES = ARMATURE * INERTIA / (ARMATURE + INERTIA)
TIME = 0.02 * np.arange(50)
PHASE = 2 * np.pi * (1 + 3 * TIME) * TIME  # 1 to 7 Hz
COMMAND, PUSHED = 1.2 * np.sin(PHASE)[:, None], 1.2 * np.sin(PHASE + 0.5)[:, None]  # motors unwound, to one side
NEUTRAL = [0.0, 0.1, 0.0]  # compliance, damping, gap
ROWS = 8


def model(actuator, integrator="Euler", armature=ARMATURE, dt=0.002):
    return ONE.format(dt=dt, integrator=integrator, armature=armature, actuator=actuator.format("link"))


def stack(where="link"):
    return [make("joint_elasticity", where=where), make("backlash", where=where)]


@functools.cache
def world(actuator, integrator="Euler", armature=ARMATURE):
    return physics(model(actuator, integrator, armature), stack())


def run(thetas, *which, command=COMMAND):
    """Motion of the link `[N, T+1]`; one compiled program per model."""
    full = [*thetas, *[NEUTRAL] * (ROWS - len(thetas))]
    return moved(world(*which), full, command)[: len(thetas), :, 0]


def sprung(frequency, ratio, actuator, integrator, command):
    """(compliance, motion by MuJoCo C) of a spring between motor and link, on which both swing at `frequency`."""
    stiffness = (2 * np.pi * frequency) ** 2 * SERIES
    damping = 2 * ratio * np.sqrt(stiffness * SERIES)
    between = f'stiffness="{stiffness}" damping="{damping}"'
    return 1 / stiffness, apart(between, actuator, integrator, command, 0.0)


def loose(gap, actuator, integrator, command):
    """Motion by MuJoCo C of a link with play, its motor at the side to which the first command pushes it."""
    between = f'limited="true" range="-{gap} {gap}" solreflimit=".001 1"'
    return apart(between, actuator, integrator, command, gap * np.sign(command[0, 0]))


def apart(between, actuator, integrator, command, start):
    """The link's motion, without the error that the timestep makes of a rigid joint."""
    two = mujoco.MjModel.from_xml_string(TWO.format(between=between, actuator=actuator.format("motor")))
    fine = truth(two, command, qpos=[0, start])[:, 0] - rigid(actuator, integrator, 0.0002, command)
    return fine + rigid(actuator, integrator, 0.002, command)


def rigid(actuator, integrator, dt, command):
    return truth(mujoco.MjModel.from_xml_string(model(actuator, integrator, dt=dt)), command)[:, 0]


@pytest.mark.slow
@pytest.mark.ci
def test_neutral_leaves_every_number_of_the_model_and_the_motion():
    """Also beside another effect. The armature is a parameter in both programs: XLA folds constants as it likes."""
    armature = Parameter(
        "armature", ARMATURE, 0.0, 0.1, attribute="armature", target="link", kind="joint", operation="absolute"
    )
    nominal, space = mujoco.MjModel.from_xml_string(model(TORQUE)), ParameterSpace([armature])
    other = make("coulomb_friction", where="link")
    alone, both = (Physics(nominal, 0.02, space, [other, *more]) for more in ([], stack()))
    theta = [ARMATURE, 0.1]
    written = both.model_of(both.world(np.array([*theta, *NEUTRAL], np.float32)))
    np.testing.assert_array_equal(written.dof_armature, np.float32(ARMATURE))
    np.testing.assert_array_equal(moved(both, [[*theta, *NEUTRAL]], COMMAND), moved(alone, [theta], COMMAND))


@pytest.mark.slow
@pytest.mark.ci
@pytest.mark.parametrize(("frequency", "ratio"), [(5, 0.05), (12, 0.1), (30, 0.05)])
def test_elasticity_is_a_spring_between_two_bodies(frequency, ratio):
    compliance, real = sprung(frequency, ratio, TORQUE, "Euler", COMMAND)
    q, without = run([[compliance, ratio, 0], NEUTRAL], TORQUE)
    effect = np.abs(without - real).max()
    assert effect > {5: 0.1, 12: 5e-3, 30: 5e-4}[frequency]
    assert np.abs(q - real).max() < 0.05 * effect + 1e-4


@pytest.mark.slow
@pytest.mark.ci
def test_a_joints_limit_is_the_motors():
    """`actuatorfrcrange` of a joint cuts what the motor gets, as the actuator's own limit does at gear 1."""
    cut = model(SERVO).replace('<joint name="link"', '<joint name="link" actuatorfrcrange="-2 2"')
    values = [[1 / 50, 0.1, 0], [0, 0.1, 0.03]]
    own = moved(physics(cut, stack()), [*values, *[NEUTRAL] * (ROWS - 2)], 0.4 * COMMAND)[..., 0]
    np.testing.assert_allclose(own[:2], run(values, LIMITED, command=0.4 * COMMAND), atol=2e-5)
    assert np.abs(own[:2] - own[2]).max(axis=1).min() > 0.02


@pytest.mark.slow
@pytest.mark.ci
@pytest.mark.parametrize(("actuator", "integrator"), [(SERVO, "implicitfast"), (LIMITED, "Euler"), (SERVO, "RK4")])
def test_position_servos_feel_the_motor(actuator, integrator):
    """Stiffness, damping and limit of the force act where the encoder is; with RK4 to first order in the step too."""
    command = 0.4 * COMMAND
    for frequency in (5, 12):
        compliance, real = sprung(frequency, 0.1, actuator, integrator, command)
        q, without = run([[compliance, 0.1, 0], NEUTRAL], actuator, integrator, command=command)
        assert np.abs(without - real).max() > 0.02
        assert np.abs(q - real).max() < (0.12 if integrator == "RK4" else 0.1) * np.abs(without - real).max()


@pytest.mark.parametrize("gap", [0.01, 0.03])
@pytest.mark.slow
@pytest.mark.ci
def test_backlash_is_play_between_two_bodies(gap):
    for actuator, integrator, size in ((TORQUE, "Euler", 1.0), (SERVO, "implicitfast", 0.4)):
        real = loose(gap, actuator, integrator, size * PUSHED)
        q, without = run([[0, 0.1, gap], NEUTRAL], actuator, integrator, command=size * PUSHED)
        assert np.abs(without - real).max() > 0.7 * gap
        assert np.abs(q - real).max() < 0.2 * np.abs(without - real).max()


@pytest.mark.slow
@pytest.mark.ci
def test_teeth_may_be_springs():
    """Play whose ends give way: MuJoCo's limit with an impedance so low that it is a spring and a damper."""
    gap, compliance, d = 0.02, 1 / 60, 0.03
    model_ = mujoco.MjModel.from_xml_string(model(TORQUE))
    own = Physics(model_, 0.02, ParameterSpace(), [make("backlash", "link").with_all()])
    soft, hard, none = moved(own, np.array([[gap, compliance, 0], [gap, 0, 0], [0, 0, 0]]), PUSHED)[..., 0]
    # its stiffness is d / (1 - d) times SERIES d k / d^2, its damping d / (1 - d) times SERIES b / d
    k, b = (1 - d) / SERIES / compliance, (1 - d) / SERIES * 2 * 0.7 * np.sqrt(SERIES / compliance)
    between = f'limited="true" range="-{gap} {gap}" solreflimit="-{k} -{b}" solimplimit="{d} {d} .001"'
    real = apart(between, TORQUE, "Euler", PUSHED, gap * np.sign(PUSHED[0, 0]))
    off = {name: np.abs(q - real).max() for name, q in (("soft", soft), ("hard", hard), ("none", none))}
    assert off["soft"] < 0.3 * off["hard"] and off["hard"] < off["none"], off


def weightless(xml):
    return mujoco.MjModel.from_xml_string(xml.replace("<option ", '<option gravity="0 0 0" '))


@pytest.mark.slow
@pytest.mark.ci
@pytest.mark.parametrize(("actuator", "integrator", "size"), [(TORQUE, "Euler", 1.0), (SERVO, "implicitfast", 0.4)])
def test_an_encoder_on_the_motor_shows_the_motor(actuator, integrator, size):
    """Without gravity, which would notice that at the start the link stands where its encoder does."""
    own = Physics(
        weightless(model(actuator, integrator)),
        0.02,
        ParameterSpace(),
        [effect.with_all() for effect in stack()],
    )
    gap, command, stiffness = 0.03, size * PUSHED, (2 * np.pi * 5) ** 2 * SERIES
    play = f'limited="true" range="-{gap} {gap}" solreflimit=".001 1"'
    spring = f'stiffness="{stiffness}" damping="{0.2 * np.sqrt(stiffness * SERIES)}"'
    rows = [
        [0, 0.1, 0, gap, 0, 1],
        [1 / stiffness, 0.1, 1, 0, 0, 0],
        [0, 0.1, 0, gap, 0, 0],
        [1 / stiffness, 0.1, 0, 0, 0, 0],
    ]
    for motor, link, between, start in ((0, 2, play, gap * np.sign(command[0, 0])), (1, 3, spring, 0.0)):
        two = weightless(TWO.format(between=between, actuator=actuator.format("motor")))
        shown = moved(own, np.array(rows), command, qpos=[start])[..., 0]
        coarse, fine = (
            truth(weightless(model(actuator, integrator, dt=dt)), command, qpos=[start])[:, 0] for dt in (0.002, 0.0002)
        )
        real = truth(two, command, qpos=[0, start])[:, 1] + coarse - fine
        apart = np.abs(shown[motor] - shown[link]).max()
        assert apart > 0.8 * gap and np.abs(shown[motor] - real).max() < 0.2 * apart


@pytest.mark.slow
@pytest.mark.ci
@pytest.mark.parametrize("integrator", ["Euler", "implicitfast"])
def test_a_joints_damping_is_the_motors(integrator):
    """Strong damping: inside the play the link swings freely and the motor does not."""
    gap, strong = 0.03, 'damping="0.3"'
    between = f'limited="true" range="-{gap} {gap}" solreflimit=".001 1"'
    two = TWO.format(between=between, actuator=TORQUE.format("motor"))
    motors, links = (
        two.replace('damping=".02"', strong),
        two.replace('damping=".02"', "").replace('damping="0"', strong),
    )
    ours = model(TORQUE, integrator).replace('damping="0.02"', strong)
    q, rigid = moved(physics(ours, stack()), [[0, 0.1, gap], *[NEUTRAL] * (ROWS - 1)], 2 * PUSHED)[:2, :, 0]
    real, other = (
        truth(mujoco.MjModel.from_xml_string(xml), 2 * PUSHED, qpos=[0, gap])[:, 0] for xml in (motors, links)
    )
    assert np.abs(q - real).max() < 0.2 * min(np.abs(rigid - real).max(), np.abs(other - real).max())


@pytest.mark.parametrize("armature", [ARMATURE, 0.0])
@pytest.mark.slow
def test_tends_to_the_rigid_joint_and_stays_finite(armature):
    which = (TORQUE, "Euler", armature)
    small = [[1e-9, 0.1, 0], [1e-6, 0.02, 0], [0, 0.1, 1e-7], [1e-8, 0.5, 1e-8]]
    q = run([NEUTRAL, *small, [10.0, 0.02, 0], [0.05, 0.5, 0.05]], *which)
    np.testing.assert_allclose(q[1:5], np.stack([q[0]] * 4), atol=5e-5)
    assert np.isfinite(q).all()


@pytest.mark.parametrize(("column", "value"), [(0, 0.02), (2, 0.03)])
def test_recovers_what_mujoco_was_given(column, value):
    frequency = 1 / np.sqrt(value * SERIES) / 2 / np.pi
    elastic = functools.partial(sprung, frequency, 0.1)
    real = loose(value, TORQUE, "Euler", PUSHED) if column else elastic(TORQUE, "Euler", PUSHED)[1]

    def simulate(points):
        full = np.tile(np.asarray(NEUTRAL), (len(points), 1))
        full[:, column] = points[:, 0]
        return run(full, TORQUE, command=PUSHED)

    (found,) = recovered(simulate, real, [0.5 * value], [value], ROWS)
    assert found == pytest.approx(value, rel=0.05)


def chain(dt, springs=None):
    """Two links in a row with armatures .02 and .01, or with motors on springs (stiffness, damping)."""
    if springs is None:
        return CHAIN.format(dt=dt, a=0.02, b=0.01, d=0.02, motors="", springs="", at="")
    motors = ROTOR.format("a", 0.02) + ROTOR.format("b", 0.01)
    between = "".join(SPRING.format(joint, *own) for joint, own in zip("ab", springs, strict=True))
    return CHAIN.format(dt=dt, a=0, b=0, d=0, motors=motors, springs=between, at="motor")


@pytest.mark.slow
@pytest.mark.ci
def test_two_places_against_mujoco_and_against_two_single_effects():
    """Both joints are solved together in the one case, one after the other in the other: not bit for bit."""
    command = np.concatenate([2 * COMMAND, -COMMAND], axis=1)
    one = physics(chain(0.002), stack(("a", "b")))
    two = physics(chain(0.002), [effect for joint in "ab" for effect in stack(joint)])
    q, play, plain = moved(
        one, [[0.02, 0.1, 0.03, 0.1, 0, 0], [0, 0.1] * 2 + [0.03, 0.02], [0, 0.1] * 2 + [0, 0]], command
    )
    other = moved(two, [[0.02, 0.1, 0, 0.03, 0.1, 0], [0, 0.1, 0.03, 0, 0.1, 0.02], NEUTRAL * 2], command)
    for together, single in ((q, other[0]), (play, other[1])):
        assert np.abs(together - plain).max() > 0.05
        assert np.abs(together - single).max() < 0.1 * np.abs(together - plain).max() + 0.005
    real, fine = (
        truth(mujoco.MjModel.from_xml_string(xml), command)
        for xml in (chain(0.0002, ((50, 0.2), (100 / 3, 0.1))), chain(0.0002))
    )
    real = real[:, :2] - fine + truth(mujoco.MjModel.from_xml_string(chain(0.002)), command)
    assert np.abs(q - real).max() < 0.1 * np.abs(plain - real).max()
