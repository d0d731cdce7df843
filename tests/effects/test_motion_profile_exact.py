"""The profile of a drive at any time step: that of continuous time, by hand and in steps of 10 us."""

import functools
import math

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from bayessim_mjx.effects import make
from bayessim_mjx.effects.acceleration_limit import trapezoid

MODEL = mujoco.MjModel.from_xml_string(
    '<mujoco><worldbody><body><joint name="x"/><geom size=".1"/></body></worldbody>'
    '<actuator><position name="servo" joint="x" kp="6"/></actuator></mujoco>'
)
TIMESTEPS = (5e-4, 2e-3, 5e-3)
VALUES = ((0.0, 0.04), (0.4, 0.04), (0.0, 0.002), (0.068, 0.00084))


@functools.cache
def stepper(h):
    effect = make("acceleration_limit", where="servo")
    at = effect.bind(MODEL, h, 1)

    @jax.jit
    def run(memory, command, theta):
        def one(memory, c):
            memory, out = effect.on_command(at, memory, c[None, None], theta)
            return memory, (memory["state"][0], memory["rate"][0] / h, out[0, 0])

        return jax.lax.scan(one, memory, command)[1]

    return effect.init(at), run


def followed(values, command, h, start=None):
    """(position, speed) after each sub-step and the mean position over it; `start`: other ones than rest there."""
    memory, run = stepper(h)
    if start is not None:
        u, v = (jnp.full(1, x, jnp.float32) for x in start)
        memory = {"state": u, "rate": v * h, "fresh": jnp.zeros((), bool)}
    return [np.asarray(x) for x in run(memory, jnp.asarray(command, jnp.float32), jnp.asarray(values, jnp.float32))]


def by_hand(t, w, slowness, b):
    """(position, speed) of a trapezoid over w > 0 from rest."""
    p = min(math.sqrt(w / b), 1 / slowness if slowness else math.inf)
    rise, total = p * b, w / p + p * b
    down = np.maximum(total - t, 0.0)
    return (
        np.select([t < rise, t < total - rise], [t**2 / (2 * b), p * (t - rise / 2)], w - down**2 / (2 * b)),
        np.select([t < rise, t < total - rise], [t / b, p + 0 * t], down / b),
    )


def stepped(values, command, h, start):
    """The same as `followed`, in steps of 10 us: the speed after one is the largest from which it can stop in time."""
    slowness, b = values
    fine, (u, v), out = 1e-5, start, []
    top = 1 / slowness if slowness else math.inf
    for c in command:
        total = 0.0
        for _ in range(round(h / fine)):
            w = c - u
            after = abs(w) - 0.5 * fine * math.copysign(v, w * v)  # and half a step of the new speed
            stops = (math.sqrt(0.25 * fine**2 + 2 * b * max(after, 0.0)) - 0.5 * fine) / b
            wanted = math.copysign(min(stops, top), w)
            now = min(max(wanted, v - fine / b), v + fine / b)
            total += u + 0.5 * fine * v
            u, v = u + fine * 0.5 * (v + now), now
        out.append((u, v, total / round(h / fine)))
    return np.transpose(out)


@pytest.mark.parametrize("h", TIMESTEPS)
@pytest.mark.parametrize("values", VALUES)
@pytest.mark.parametrize("size", [1.0, -0.3, 0.01])
def test_a_held_target_is_reached_along_the_trapezoid(values, h, size):
    command = np.full(round(0.8 / h), size)
    u, v, mean = followed(values, command, h, (0.0, 0.0))
    t = h * np.arange(1, len(command) + 1)
    position, speed = by_hand(t, abs(size), *values)
    np.testing.assert_allclose(u * np.sign(size), position, atol=2e-5 * abs(size))  # rounding of 1600 sums
    np.testing.assert_allclose(v * np.sign(size), speed, atol=2e-4 * speed.max() + 0.03 * h / values[1])
    within = np.mean([by_hand(t - h * (1 - s), abs(size), *values)[0] for s in (np.arange(50) + 0.5) / 50], 0)
    np.testing.assert_allclose(mean * np.sign(size), within, atol=2e-5 * abs(size) + 1e-4 * h**2 / values[1])
    assert u[-1] == mean[-1] == np.float32(size)
    assert v[-1] == 0.0


@pytest.mark.parametrize("h", TIMESTEPS)
@pytest.mark.parametrize(
    ("start", "target"),
    [
        ((0.0, 3.0), 1.0),  # on its way
        ((0.0, -3.0), 1.0),  # away
        ((0.8, 4.0), 1.0),  # too fast to stop there
        ((0.9, 9.0), 1.0),  # above the limit of speed, too
        ((-2.0, 9.0), 1.0),  # above it, with room
        ((0.5, -9.0), 1.0),
    ],
)
def test_from_any_motion_it_takes_the_quickest_way(start, target, h):
    command, values = np.full(round(0.9 / h), target), (0.2, 0.02)
    got, expected = followed(values, command, h, start), stepped(values, command, h, start)
    for own, other, allowed in zip(got, expected, (1e-4, 1e-2, 1e-4), strict=True):
        np.testing.assert_allclose(own, other, atol=allowed)
    assert got[0][-1] == target
    assert got[1][-1] == 0.0


@pytest.mark.parametrize("h", TIMESTEPS)
@pytest.mark.parametrize("values", VALUES)
def test_targets_that_change_every_control_step(values, h):
    rows, t = round(0.02 / h), np.arange(40) * 0.02
    moving = 1.2 * np.sin(2 * np.pi * t) + 0.3 * np.sin(2 * np.pi * 2.6 * t + 1)
    command = np.append(moving, np.random.default_rng(0).choice([-0.5, 0.0, 0.7], 20)).repeat(rows)
    got = followed(values, command, h)
    expected = stepped(values, np.float32(command).astype(float), h, (command[0], 0.0))
    np.testing.assert_allclose(got[0], expected[0], atol=2e-4)
    np.testing.assert_allclose(got[2], expected[2], atol=2e-4)


@pytest.mark.parametrize("h", TIMESTEPS)
@pytest.mark.parametrize("values", VALUES)
def test_neither_limit_is_exceeded_and_a_rest_lasts(values, h):
    """Also where braking for the command leaves a difference of two equal numbers to the rounding."""
    rng = np.random.default_rng(1)
    command = np.append(rng.choice([-1.0, 0.0, 0.3, 1.0], 100).repeat(round(0.06 / h)), np.full(round(1 / h), 0.3))
    u, v, mean = followed(values, command, h)
    slowness, b = values
    assert np.abs(np.diff(v)).max() <= h / b * (1 + 1e-4)
    assert np.abs(v).max() <= (1 / slowness if slowness else np.inf) * (1 + 1e-6)
    assert len(set(u[-20:])) == len(set(mean[-20:])) == 1
    assert u[-1] == mean[-1] == np.float32(0.3)
    assert not v[-20:].any()


def test_one_that_arrives_within_a_sub_step_is_there_and_stands():
    left, rate, mean = (float(x) for x in jax.jit(trapezoid)(*map(jnp.float32, (0.01, 0.0, 0.0, 16.0))))
    assert (left, rate) == (0.0, 0.0)
    assert mean == pytest.approx(0.01 * math.sqrt(0.01 * 16))  # half of the way for 2 sqrt(w b)
    for still in ((0.0, 0.0, 0.0, 4.0), (0.0, 0.0, 3.0, 4.0), (0.0, 0.0, 3.0, 0.0), (5.0, 0.0, 0.0, 0.0)):
        assert [float(x) for x in jax.jit(trapezoid)(*map(jnp.float32, still))] == [0.0, 0.0, 0.0]


def test_derivatives_are_finite_everywhere_and_right_where_known():
    rng = np.random.default_rng(2)
    n = 20000
    way, rate = (rng.choice([0.0, 1.0, -1.0], n) * 10 ** rng.uniform(-7, 1, n) for _ in range(2))
    slowness = rng.choice([0.0, 1.0], n) * 10 ** rng.uniform(-3, 3, n)
    inertness = rng.choice([0.0, 1.0, 1.0], n) * 10 ** rng.uniform(-6, 7, n)
    way[::3] = (0.5 * inertness * rate * np.abs(rate))[::3]  # where it has just to brake
    given = [jnp.asarray(x, jnp.float32) for x in (way, rate, slowness, inertness)]
    for d in (jax.jacfwd, jax.jacrev):
        for part in jax.tree.leaves(jax.jit(jax.vmap(d(trapezoid, (0, 1, 2, 3))))(*given)):
            assert np.isfinite(part).all()
    # speeding up from rest: t^2 / (2 b) of the way, speed t / b
    slope = jax.jacfwd(trapezoid, 3)(*map(jnp.float32, (1.0, 0.0, 0.0, 20.0)))
    np.testing.assert_allclose(slope, [1 / 800, -1 / 400, 1 / 2400], rtol=1e-4)
    # cruising at p = 1 / slowness after b (p - v): p - b (p - v)^2 / 2 of the way
    slope = jax.jacfwd(trapezoid, 2)(*map(jnp.float32, (50.0, 0.99, 1.0, 4.0)))
    np.testing.assert_allclose(slope[0], 1 - 4 * 0.01, rtol=1e-3)
