"""What sensors show, by hand from the true motion; and starts in the middle of a recording."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.signal import lsim

from bayessim_mjx import registry
from bayessim_mjx.effects import make
from bayessim_mjx.effects.support.motion import Motion
from bayessim_mjx.errors import UserError
from bayessim_mjx.parameters import ParameterSpace
from bayessim_mjx.physics import Drive, Physics, begin, control_step
from bayessim_mjx.physics.controllers import Law

DT, STEPS = 0.02, 60
NAMES = ("joint_offset", "sensor_gain", "sensor_filter", "sensor_delay")  # the last sees what the others show
XML = """
<mujoco>
  <option timestep="0.005" gravity="0 0 0"/>
  <default><geom type="capsule" fromto="0 0 0 .4 0 0" size=".03" mass="1" contype="0"/></default>
  <worldbody>
    <body><joint name="a" axis="0 1 0" damping=".3"/><geom/></body>
    <body><joint name="b" axis="0 1 0" damping=".3" stiffness="2"/><geom/></body>
  </worldbody>
  <actuator>
    <position name="a" joint="a" kp="8" kv=".2" gear="2" ctrlrange="-2 2" ctrllimited="true"/>
    <motor name="b" joint="b"/>
  </actuator>
</mujoco>
"""
T = DT * np.arange(STEPS)
ROWS = DT * np.arange(STEPS + 1)  # of what is measured: with the start
COMMAND = np.stack([0.8 * np.sin(4 * T) + 0.3 * np.sin(9 * T), np.sin(5 * T)], axis=1)
START = np.array([0.3, -0.2]), np.array([0.5, -1.0])


def physics_of(effects):
    return Physics(mujoco.MjModel.from_xml_string(XML), DT, ParameterSpace(), effects)


@pytest.fixture(scope="module")
def full():
    return physics_of([make(n, where=("a", "b")) for n in NAMES])


def theta_of(physics, values):
    theta = np.array(physics.space.nominal)
    for name, value in values.items():
        theta[physics.space.names.index(name)] = value
    return theta


@functools.lru_cache
def episode(physics):
    """(theta, true qpos, true qvel, commands) -> what is measured at the start and after every control step."""

    def run(theta, qpos, qvel, commands):
        def body(world, command):
            world, _ = control_step(physics, world, command)
            return world, (world.measurement["qpos"], world.measurement["qvel"])

        world = physics.world(theta, qpos, qvel)
        start = world.measurement["qpos"], world.measurement["qvel"]
        after = jax.lax.scan(body, world, commands)[1]
        return tuple(jnp.concatenate([one[None], rest]) for one, rest in zip(start, after, strict=True))

    return jax.jit(run)


def shown(physics, values, command=COMMAND):
    """(qpos, qvel) `[T+1, 2]` as measured of an episode that truly begins at START."""
    out = episode(physics)(theta_of(physics, values).astype(np.float32), *START, command)
    return tuple(np.asarray(x) for x in out)


@pytest.mark.slow
@pytest.mark.ci
def test_neutral_changes_no_bit(full):
    for names, values in (((), {}), (("sensor_gain",), {"a.sensor_gain.gain": 1.1})):
        bare = physics_of([make(n, where=("a", "b")) for n in names])
        for one, two in zip(shown(bare, values), shown(full, values), strict=True):
            assert np.array_equal(one, two)


@pytest.mark.slow
@pytest.mark.ci
def test_two_places_are_two_single_effects(full):
    values = dict(joint_offset=("offset", 0.05), sensor_gain=("gain", 0.9))
    values |= dict(sensor_filter=("time_constant", 0.03), sensor_delay=("delay", 0.035))
    values = {f"{j}.{n}.{k}": v * s for n, (k, v) in values.items() for j, s in (("a", 1.0), ("b", 1.05))}
    singles = physics_of([make(n, where=j) for n in NAMES for j in "ab"])
    for one, two in zip(shown(full, values), shown(singles, values), strict=True):
        np.testing.assert_allclose(one, two, atol=1e-6)


def test_gain_scales_what_is_shown(full):
    true, seen = shown(full, {}), shown(full, {"b.sensor_gain.gain": 1.15})
    for x, y in zip(true, seen, strict=True):
        np.testing.assert_allclose(y, x * [1.0, 1.15], rtol=1e-6, atol=1e-7)


def test_a_reset_is_measured_too(full):
    """What is shown of the start is what a robot at rest there would show: delays and filters know nothing else."""
    own = {"joint_offset.offset": 0.1, "sensor_gain.gain": 1.1}
    slow = {"sensor_filter.time_constant": 0.04, "sensor_delay.delay": 0.03}
    for values in (own, own | slow):
        qpos, qvel = shown(full, {f"a.{k}": v for k, v in values.items()})
        np.testing.assert_allclose(qpos[0], [1.1 * (START[0][0] + 0.1), START[0][1]], rtol=1e-6)
        np.testing.assert_allclose(qvel[0], [1.1 * START[1][0], START[1][1]], rtol=1e-6)


def test_a_policy_sees_its_first_observation_through_the_sensors():
    bare, off = (registry.make("Pendulum", effects=e) for e in ([], [make("joint_offset", where="hinge")]))
    nominal, (q, w, o) = jnp.asarray(bare.space.nominal), np.float32([[0.7], [0.2], [0.06]])

    @jax.jit
    def observed():
        return off.reset_to(q, w, jnp.append(nominal, o)).obs["policy"], bare.reset_to(q + o, w, nominal).obs["policy"]

    np.testing.assert_allclose(*observed(), atol=1e-6)


@pytest.mark.slow
def test_a_declared_controller_knows_static_errors_and_no_delay(full):
    """A drive has its own encoder: with its offset and scale, without the bus and filters between it and the log.

    kp (c - g q) - kd g w is the law with g kp, g kd and c / g on the true angle.
    """

    def run(theta, gain, command):
        gains = jnp.array([0.0, 25.0]) * gain, jnp.array([0.0, 1.5]) * gain
        rest = dict(limit=jnp.full(2, jnp.inf), scale=jnp.ones(2), qadr=(0, 1), dadr=(0, 1))
        law = Law(jnp.array([0.0, 1.0]), jnp.zeros(2), *gains, **rest)

        def body(world, row):
            world, _ = control_step(full, world, row, Drive(law=law))
            return world, world.qpos

        return jax.lax.scan(body, full.world(theta, *START), command)[1]

    slow = {"b.sensor_filter.time_constant": 0.04, "b.sensor_delay.delay": 0.03}
    cases = [({}, 1, COMMAND), (slow, 1, COMMAND), ({"b.sensor_gain.gain": 1.2}, 1, COMMAND)]
    cases += [({}, 1.2, COMMAND / [1, 1.2]), ({"b.joint_offset.offset": 0.1}, 1, COMMAND), ({}, 1, COMMAND - [0, 0.1])]
    thetas, gains, commands = zip(*cases, strict=True)
    thetas = np.float32([theta_of(full, values) for values in thetas])
    plain, late, scaled, strong, shifted, less = jax.jit(jax.vmap(run))(thetas, np.float32(gains), np.float32(commands))
    for one, two in ((plain, late), (scaled, strong), (shifted, less)):
        np.testing.assert_allclose(one, two, atol=1e-5)
    assert np.abs(plain - scaled).max() > 0.02 and np.abs(plain - shifted).max() > 0.02


def path(qpos, qvel, times):
    """Position at `times` when the acceleration is constant in every control step; the first one held before."""
    qpos, qvel, rows = (np.concatenate([x[:1]] * 5 + [x]) for x in (qpos, qvel, np.zeros_like(qpos)))
    k = np.clip(np.floor(times / DT + 1e-9).astype(int) + 5, 0, len(qpos) - 2)
    s = times - DT * (k - 5)
    slope, bend = np.diff(qpos)[k] / DT, np.diff(qvel)[k] / DT
    return qpos[k] + slope * s - bend / 2 * s * (DT - s)


def speed(qpos, qvel, times):
    """Velocity at `times` when the acceleration is linear in every control step and the steps' mean velocities fit.

    Semi-implicit Euler's velocities are those of half a timestep, 2.5 ms, before. The first one is held before.
    """
    k = np.clip(np.floor(times / DT + 1e-9).astype(int), 0, len(qpos) - 2)
    s = np.clip(times / DT - k, 0, None)
    mean = np.diff(qpos)[k] / DT - 0.0025 * np.diff(qvel)[k] / DT
    return np.interp(times, ROWS, qvel) + 6 * (mean - (qvel[k] + qvel[k + 1]) / 2) * s * (1 - s)


@pytest.mark.parametrize("delay", [0.005, 0.02, 0.031, 0.05])
def test_delay_shows_the_past(full, delay):
    true, seen = shown(full, {}), shown(full, {"b.sensor_delay.delay": delay})
    x, v = (y[:, 1] for y in true)
    np.testing.assert_allclose(seen[0][:, 1], path(x, v, ROWS - delay), atol=3e-6)
    np.testing.assert_allclose(seen[1][:, 1], speed(x, v, ROWS - delay), atol=3e-5)
    for x, y in zip(true, seen, strict=True):
        assert np.array_equal(x[:, 0], y[:, 0])


@pytest.mark.parametrize("constant", [1e-6, 0.004, 0.05])
def test_filter_is_the_exact_low_pass(full, constant):
    """Against scipy's simulation of T y' = q - y on a fine grid, settled at the first value."""
    true, seen = shown(full, {}), shown(full, {"b.sensor_filter.time_constant": constant})
    (q, v), a, fine = (x[:, 1] for x in true), 1 / constant, DT / 50 * np.arange(50 * STEPS + 1)
    for x, y, inner in zip(true, seen, (path(q, v, fine), speed(q, v, fine)), strict=True):
        low = inner if constant < 1e-5 else inner[0] + lsim(([a], [1, a]), inner - inner[0], fine)[1]
        np.testing.assert_allclose(y[:, 1], low[::50], atol=2e-4 if constant < 1e-5 else 3e-5)
        assert np.array_equal(x[:, 0], y[:, 0])


@pytest.mark.parametrize("name", ["sensor_delay", "sensor_filter"])
def test_what_is_shown_goes_to_the_truth_with_the_parameter(full, name):
    """The change is proportional to a small parameter: -p w for both, no jump at zero."""
    key = "delay" if name == "sensor_delay" else "time_constant"
    (q, v), small = shown(full, {}), 1e-4
    change = shown(full, {f"b.{name}.{key}": small})[0][3:, 1] - q[3:, 1]
    # semi-implicit Euler's velocity is half a sub-step behind its path: up to 15 rad/s^2 * 2.5 ms
    np.testing.assert_allclose(change / small, -v[3:, 1], atol=0.1)


def test_a_servo_with_an_offset_turns_to_command_minus_offset(full):
    """True motion = that of the command c - o without offset; a motor's command does not shift."""
    seen = shown(full, {"a.joint_offset.offset": 0.07, "b.joint_offset.offset": -0.03})
    # gear 2: the servo's length is twice the angle, so the command shifts by twice the offset
    shifted = shown(full, {}, COMMAND - [2 * 0.07, 0.0])
    np.testing.assert_allclose(seen[0] - [0.07, -0.03], shifted[0], atol=1e-6)
    np.testing.assert_allclose(seen[1], shifted[1], atol=5e-6)


def test_a_servo_with_an_offset_at_the_end_of_ctrlrange(full):
    """Command 2 at gear 2 means 1 rad on the encoder, so 1.08 rad in truth; ctrlrange ends at 2."""
    physics = physics_of([make("joint_offset", where="a")])
    qpos, _ = shown(physics, {"a.joint_offset.offset": -0.08}, np.tile([[2.0, 0.0]], (250, 1)))
    assert qpos[-1, 0] == pytest.approx(1.0, abs=1e-3)


CASES = {
    "joint_offset": ({"offset": 0.06}, 1e-5),
    "sensor_gain": ({"gain": 0.9}, 1e-5),
    "sensor_filter": ({"time_constant": 0.04}, 1e-3),
    "sensor_delay": ({"delay": 0.033}, 1e-3),
    "whole step": ({"sensor_delay.delay": 0.04}, 1e-5),
    "all": (
        {
            "joint_offset.offset": 0.06,
            "sensor_gain.gain": 0.9,
            "sensor_filter.time_constant": 0.03,
            "sensor_delay.delay": 0.033,
        },
        3e-3,
    ),
}


@pytest.fixture(scope="module")
def continued(full):
    """Measured (qpos, qvel) `[STEPS - start, 2]` after a start in the middle of a recording."""

    def run(theta, motion, commands):
        def body(world, command):
            world, _ = control_step(full, world, command)
            return world, (world.measurement["qpos"], world.measurement["qvel"])

        return jax.lax.scan(body, begin(full, theta, motion), commands)[1]

    return jax.jit(run)


@pytest.mark.parametrize("case", CASES)
def test_a_start_in_the_middle_goes_on_as_the_recording(full, continued, case):
    """Exact for what can be undone exactly; a fractional delay and a filter up to dt^2 terms (see CASES, rad)."""
    own, tolerance = CASES[case]
    values = {f"{j}.{k if '.' in k else f'{case}.{k}'}": v for j in "ab" for k, v in own.items()}
    logged = shown(full, values)
    rows, start = slice(10, 40), 15
    command = np.repeat(COMMAND[:, None], full.substeps, axis=1)
    arrays = [jnp.asarray(x[rows], jnp.float32) for x in (*logged, command)]
    qpos, qvel = continued(
        jnp.asarray(theta_of(full, values)), Motion(*arrays, start=start), jnp.asarray(command[10 + start :])
    )
    np.testing.assert_allclose(qpos, logged[0][11 + start :], atol=tolerance)
    np.testing.assert_allclose(qvel, logged[1][11 + start :], atol=25 * tolerance)


@pytest.mark.parametrize("case", [c for c in CASES if c in NAMES])
def test_recovers_a_hidden_value(full, case):
    ((key, truth),) = CASES[case][0].items()
    neutral = float(key == "gain")

    def residual(x):
        seen = shown(full, {f"a.{case}.{key}": x[0], f"b.{case}.{key}": x[1]}, COMMAND)
        return np.concatenate([(s - m).ravel() for s, m in zip(seen, logged, strict=True)])

    values = np.array([truth, neutral + 0.7 * (truth - neutral)])
    logged = shown(full, {f"a.{case}.{key}": values[0], f"b.{case}.{key}": values[1]}, COMMAND)
    fit = least_squares(residual, neutral + 0.4 * (values - neutral), diff_step=1e-2)
    np.testing.assert_allclose(fit.x - neutral, values - neutral, rtol=0.02)


def test_the_memory_of_a_delay_grows_with_its_range():
    for high, rows in ((0.05, 3), (0.3, 15), (0.01, 2)):
        assert physics_of([make("sensor_delay", where="all", high=high)]).world(np.zeros(1)).memory[0][
            "history"
        ].shape == (rows, 2, 2)


def test_refusals_and_what_cannot_be_written():
    effect = make("sensor_gain", where="a")
    with pytest.raises(UserError, match="a.sensor_gain.gain: range begins at 0; allowed: above 0"):
        dataclasses.replace(effect, parameters=(dataclasses.replace(effect.space().parameters[0], low=0.0),))
    for name in NAMES:
        assert "use effects.yaml" in make(name, where="a").edit(mujoco.MjSpec.from_string(XML), {"a": {}})
