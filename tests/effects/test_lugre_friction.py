"""Bristles against their differential equation in float64, by hand, and against friction without presliding."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from bayessim_mjx.effects import lugre_friction, make
from bayessim_mjx.effects.support.motion import Motion
from bayessim_mjx.errors import UserError
from tests.effects.truths import CONTROL, moved, physics, recovered

MASS = 2.0
LIFT = """
<mujoco>
  <option timestep="{timestep}"/>
  <worldbody><body><joint name="z" type="slide" axis="0 0 1"/><geom size=".1" mass="2" contype="0"/></body></worldbody>
  <actuator><motor joint="z"/></actuator>
</mujoco>
"""
ARM = """
<mujoco>
  <option timestep="{timestep}"/>
  <worldbody><body>
    <joint name="a" axis="0 1 0"/><geom type="capsule" fromto="0 0 0 .5 0 0" size=".03" mass="1" contype="0"/>
    <body pos=".5 0 0">
      <joint name="b" axis="0 1 0"/><geom type="capsule" fromto="0 0 0 .4 0 0" size=".03" mass=".5" contype="0"/>
    </body>
  </body></worldbody>
  <actuator><motor joint="a"/><motor joint="b"/></actuator>
</mujoco>
"""
OWN = (3.0, 2.0, 0.5, 0.01)  # level, excess, speed, bend
ROWS, STEPS = 16, 100
WEIGHT = MASS * 9.81


def lifted(timestep):
    effects = [make("lugre_friction", where="z"), make("viscous_friction", where="z")]
    return physics(LIFT.format(timestep=timestep), effects)


FINE, COARSE = lifted(0.005), lifted(CONTROL)
SLOW = [pytest.mark.slow, pytest.mark.ci]


def run(thetas, command, world=FINE, damping=0.0, **start):
    """Positions `[N, STEPS+1]` under a force besides the weight, held at its last value."""
    full = [[*t, damping] for t in [*thetas, *[OWN] * (ROWS - len(thetas))]]
    command = np.pad(np.asarray(command, float), (0, STEPS - len(command)), "edge") + WEIGHT
    return moved(world, full, command[:, None], **start)[: len(thetas), :, 0]


def exact(command, level, excess, speed, bend, ratio=0.7):
    """The same by scipy, commands held over control steps."""
    s0 = (level + excess) / bend
    s1 = 2 * ratio * np.sqrt(s0 * MASS)
    state, out = np.zeros(3), [0.0]
    for u in command:

        def motion(_, y, u=u):
            _, w, z = y
            slip = w - s0 * abs(w) / (level + excess * np.exp(-((w / speed) ** 2))) * z
            return w, (u - s0 * z - s1 * slip) / MASS, slip

        state = solve_ivp(motion, (0, CONTROL), state, method="LSODA", rtol=1e-7, atol=1e-9).y[:, -1]
        out.append(state[0])
    return np.array(out)


TIMES = CONTROL * np.arange(STEPS)
RAMP = np.sin(np.minimum(TIMES / 1.5, 1.0) * np.pi / 2) ** 2
SWEEP = 12.0 * np.sin(5 * TIMES) + 4.0 * np.sin(17 * TIMES)


@pytest.fixture(scope="module")
def swept():
    return exact(SWEEP, *OWN)


@pytest.mark.parametrize(
    ("world", "timestep"),
    [pytest.param(FINE, 0.005, id="5 ms"), pytest.param(COARSE, CONTROL, id="20 ms", marks=SLOW)],
)
@pytest.mark.slow
@pytest.mark.ci
def test_is_the_differential_equation_to_the_order_of_the_sub_step(swept, world, timestep):
    """Reversals, breakaway and sliding at 1 m/s; off by no more than the way of a sub-step."""
    (q,) = run([OWN], SWEEP, world)
    fastest = np.abs(np.diff(swept)).max() / CONTROL
    assert np.ptp(swept) > 0.3 and fastest > 1.0
    np.testing.assert_allclose(q, swept, atol=fastest * timestep)


def test_presliding_is_a_spring_that_softens():
    """Slowly pushed with F from rest: F = g (1 - exp(-x / bend)); its stiffness at 0 is g / bend."""
    for share in (0.02, 0.2, 0.5):
        (q,) = run([(5.0, 0.0, 0.5, 0.01)], 5.0 * share * RAMP)
        assert q[-1] == pytest.approx(-0.01 * np.log(1 - share), rel=0.02)


def test_it_breaks_away_at_level_and_excess():
    for sign in (-1, 1):
        assert abs(run([OWN], sign * 4.6 * RAMP)[0, -1]) < 0.04
        assert abs(run([OWN], sign * 5.6 * RAMP)[0, -1]) > 0.1


def test_in_steady_motion_it_is_the_curve_of_stribeck():
    """Pushed against viscous friction b too: level + excess exp(-(v / speed)^2) + b v is the push."""
    (q,) = run([OWN], [8.0], damping=8.0)
    w = (q[-1] - q[-2]) / CONTROL
    assert 3.0 + 2.0 * np.exp(-((w / 0.5) ** 2)) + 8.0 * w == pytest.approx(8.0, rel=3e-3)


@pytest.mark.slow
@pytest.mark.ci
def test_stiff_bristles_are_stribeck_friction():
    """In coupled joints too, and not by what either would do alone."""
    t = CONTROL * np.arange(60)[:, None]
    command = np.concatenate([6 * np.sin(7 * t), 2.5 * np.sin(11 * t + 1)], 1)
    values = [[0.8, 0.5, 0.4], [0.3, 0.2, 0.3]]
    arm = ARM.format(timestep=0.004)
    want = moved(physics(arm, [make("stribeck_friction", where=("a", "b"))]), [np.ravel(values)], command)[0]
    world = physics(arm, [make("lugre_friction", where=("a", "b"))])
    bends = [[*v, bend] for bend in (1e-6, 0.03) for v in values]
    got = moved(world, [np.ravel(bends[:2]), np.ravel(bends[2:])], command)
    np.testing.assert_allclose(got[0], want, rtol=2e-3, atol=5e-3)
    assert np.abs(got[1] - want).max() > 0.05 and np.ptp(want) > 1.0


@pytest.mark.slow
@pytest.mark.ci
def test_neutral_changes_no_bit_beside_another_effect():
    spring = make("joint_spring", where="a")
    command = 3 * np.sin(np.arange(60)[:, None] * [0.3, 0.5])
    theta = [2.0, 0.0, 0.3]
    arm = ARM.format(timestep=0.004)
    alone = moved(physics(arm, [spring]), [theta], command)
    off = [0.0, 0.0, 0.3, 0.01] * 2
    beside = moved(physics(arm, [spring, make("lugre_friction", where=("a", "b"))]), [[*theta, *off]], command)
    np.testing.assert_array_equal(beside, alone)


@pytest.mark.slow
@pytest.mark.ci
def test_no_corner_of_the_ranges_is_unstable():
    """Of 20 ms sub-steps: pushed by nothing, no joint gets faster, and all stay finite."""
    corners = [(f, e, s, b) for f in (0.0, 50.0) for e in (0.0, 50.0) for s in (0.01, 2.0) for b in (1e-4, 0.1)]
    q = run(corners, [0.0], COARSE, qvel=[3.0])
    speed = np.abs(np.diff(q, axis=1)) / CONTROL
    assert np.isfinite(q).all()
    assert speed.max() <= 3.0 + 1e-3
    assert (speed[[f > 0 and b < 1e-3 for f, _, _, b in corners], -1] < 0.01).all()


def test_what_it_holds_at_the_start_does_not_sag():
    """The bristles are as bent as the load wants them when an episode begins."""
    (q,) = run([(25.0, 0.0, 0.5, 0.02)], [-WEIGHT])
    assert np.abs(q).max() < 1e-5


def test_a_recorded_past_bends_the_bristles():
    """After a way x in one direction, f = g (1 - exp(-x / bend)); of what was before, exp(-x / bend) is left."""
    at = FINE.sites[0]
    effect, rows = FINE.effects[0], 6
    qpos = jnp.linspace(0.0, -0.008, rows)[:, None]
    motion = Motion(qpos, jnp.full((rows, 1), -0.08), jnp.zeros((rows, 4, 1)), rows - 1)
    theta = jnp.array([3.0, 0.0, 0.5, 0.01])
    memory, same = jax.jit(effect.on_start, static_argnums=0)(at, effect.init(at), motion, theta)
    assert float(memory["force"][0]) == pytest.approx(-(1 - np.exp(-0.8)), rel=1e-4)
    assert float(memory["unknown"][0]) == pytest.approx(np.exp(-0.8), rel=1e-4)
    np.testing.assert_array_equal(same.qpos, qpos)
    there = lugre_friction.wound(
        memory, jnp.array([[0.005]]), jnp.full((1, 1), 3.0), jnp.array([3.0]), jnp.array([0.01])
    )
    want = 1 - np.exp(-0.5) * (1 - float(memory["force"][0]))
    assert float(there["force"][0]) == pytest.approx(want, rel=1e-4)


def test_recovers_hidden_values():
    def simulate(points):
        return run(np.abs(points), SWEEP)

    (real,) = run([OWN], SWEEP)
    found = recovered(simulate, real, [2.0, 1.0, 0.4, 0.02], [1.0, 1.0, 0.3, 0.01], ROWS)
    np.testing.assert_allclose(np.abs(found), OWN, rtol=0.03)


def test_refusals():
    with pytest.raises(UserError, match="ratio = -1.0; allowed: from 0"):
        make("lugre_friction", where="z", ratio=-1.0)
