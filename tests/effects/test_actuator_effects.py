"""Nine effects of actuators on an arm of two links, against C MuJoCo with the same equations written in float64.

All are in one stack, of which a world switches on one: few programs are compiled, and eight are always at neutral.
"""

from functools import lru_cache

import mujoco
import numpy as np
import pytest
from scipy.optimize import least_squares

from bayessim_mjx.effects import make
from bayessim_mjx.parameters import ParameterSpace
from bayessim_mjx.physics import Physics
from bayessim_mjx.rollout import replay

DT, TIMESTEP, STEPS, WORLDS = 0.02, 0.005, 40, 10
KP, KV, LIMIT = 6.0, 0.4, 2.5
XML = """
<mujoco>
  <option timestep="0.005"/>
  <worldbody>
    <body>
      <joint name="shoulder" axis="0 1 0" damping="0.15"/>
      <geom type="capsule" fromto="0 0 0 0 0 -.3" size=".02" mass=".8" contype="0"/>
      <body pos="0 0 -.3">
        <joint name="elbow" axis="0 1 0" damping="0.05" armature="0.01"/>
        <geom type="capsule" fromto="0 0 0 0 0 -.3" size=".02" mass=".4" contype="0"/>
      </body>
    </body>
  </worldbody>
  <actuator>{}</actuator>
</mujoco>
"""
MODEL = XML.format("""
    <motor name="motor" joint="shoulder" gear="2"/>
    <position name="servo" joint="elbow" kp="6" kv="0.4" forcerange="-2.5 2.5"/>""")
MOTORS = XML.format('<motor joint="shoulder" gear="2"/><motor joint="elbow"/>')
PLACES = ("motor", "servo")
# true values, one row per place
TRUE = {
    "actuator_deadband": [[0.3], [0.08]],
    "rate_limit": [[0.05], [0.3]],
    "actuator_lag": [[0.013], [0.06]],
    "actuator_gain": [[0.7], [1.3]],
    "actuator_bias": [[0.3], [-0.4]],
    "effort_loss": [[0.4], [0.7]],
    "actuator_saturation": [[1.1], [0.8]],
    "speed_torque_limit": [[0.5, 0.12], [0.6, 0.1]],
    "cogging": [[0.25, -0.2, 6.0], [0.0, 0.0, 2.0]],
}
NATIVE = ("actuator_gain", "actuator_bias", "actuator_saturation")
EACH = pytest.mark.parametrize("name", sorted(TRUE))


def commands():
    """`[STEPS, 2]`: steps and a sweep, N m and rad."""
    t = DT * np.arange(STEPS)
    steps = np.random.default_rng(3).choice([-1.5, -0.4, 0.4, 1.5], STEPS // 5).repeat(5)
    return np.c_[steps + 0.5 * np.sin(9 * t), 0.8 * np.sin(4 * t + 3 * t**2) + 0.3 * np.sign(steps)].astype(np.float32)


@lru_cache
def physics(layout):
    """All effects and dry friction: at both places at once, one by one, or with tied values."""
    where = {"together": [PLACES], "one by one": PLACES, "tied": ["all"], "none": []}[layout]
    stack = [make(name, where=w) for name in TRUE for w in where]
    friction = [make("coulomb_friction", where="elbow")]
    return Physics(mujoco.MjModel.from_xml_string(MODEL), DT, ParameterSpace(), stack + friction)


def theta(p, chosen=None, values=(), friction=0.0):
    """Neutral, but for the effect `chosen`: values `[places, quantities]`."""
    vector = p.space.vector({"elbow.coulomb_friction.level": friction})
    if chosen:
        at = [i for i, n in enumerate(p.space.names) if n.split(".")[1] == chosen]
        vector[at] = np.ravel(values)
    return vector


def motion(p, thetas):
    """qpos and qvel, `[len(thetas), STEPS + 1, 4]`; always as many worlds, for one program."""
    rows = np.resize(np.asarray(thetas, np.float32), (WORLDS, len(p.space)))
    seen = replay(p, *np.zeros((2, WORLDS, 2)), np.broadcast_to(commands(), (WORLDS, STEPS, 2)), rows)
    return np.concatenate([seen["qpos"], seen["qvel"]], -1)[: len(thetas)]


@lru_cache
def with_each_on():
    p = physics("together")
    return dict(zip(TRUE, motion(p, [theta(p, name, v) for name, v in TRUE.items()]), strict=True))


def dead_zone(c, x, v):
    """Here the equations once more, in float64; v: `[quantities, places]`."""
    error = c - np.array([0.0, x[1]])
    return c - np.clip(error, -v[0], v[0])


def speed_limited(f, w, v):
    stall, no_load = 1 / v[0], 1 / v[1]
    driving = stall * np.maximum(1 - np.abs(w) / no_load, 0)
    return np.sign(f) * np.minimum(np.abs(f), np.where(f * w > 0, driving, stall))


FORCES = {
    "actuator_gain": lambda f, x, w, v: v[0] * f,
    "actuator_bias": lambda f, x, w, v: f + v[0],
    "effort_loss": lambda f, x, w, v: f / (1 + v[0] * np.abs(f)),
    "actuator_saturation": lambda f, x, w, v: np.clip(f, -1 / v[0], 1 / v[0]),
    "speed_torque_limit": lambda f, x, w, v: speed_limited(f, w, v),
    "cogging": lambda f, x, w, v: f + v[0] * np.sin(v[2] * x) + v[1] * np.cos(v[2] * x),
}
RATES = {
    "actuator_lag": lambda c, u, v: (c - u) / v[0],
    "rate_limit": lambda c, u, v: np.clip((c - u) / 1e-4, -1 / v[0], 1 / v[0]),
}


def follower(name, c, u, v, pieces=500):
    """(u at the end of a sub-step, its mean) by small explicit steps of du/dt."""
    path = []
    for _ in range(pieces):
        rate = RATES[name](c, u, v)
        path.append(u + rate * TIMESTEP / pieces / 2)
        u = u + rate * TIMESTEP / pieces
    return u, np.mean(path, axis=0)


def reference(name):
    v = np.array(TRUE[name]).T
    model = mujoco.MjModel.from_xml_string(MOTORS)
    data, u = mujoco.MjData(model), commands()[0].astype(float)
    rows = [np.zeros(4)]
    for row in commands().astype(float):
        for _ in range(round(DT / TIMESTEP)):
            mujoco.mj_step1(model, data)
            x, w, c = data.actuator_length, data.actuator_velocity, row
            if name in RATES:
                u, c = follower(name, row, u, v)
            if name == "actuator_deadband":
                c = dead_zone(row, x, v)
            servo = np.clip(KP * (c[1] - x[1]) - KV * w[1], -LIMIT, LIMIT)
            force = np.array([c[0], servo])
            data.ctrl[:] = FORCES[name](force, x, w, v) if name in FORCES else force
            mujoco.mj_step2(model, data)
        rows.append(np.r_[data.qpos, data.qvel])
    return np.array(rows)


@EACH
@pytest.mark.slow
@pytest.mark.ci
def test_follows_its_equation(name):
    """To 3e-4 rad and rad/s (rounding), where the effect itself moves by 0.1 at the least."""
    got, plain = with_each_on()[name], motion(physics("together"), [theta(physics("together"))])[0]
    assert np.abs(got - plain).max() > 0.1
    np.testing.assert_allclose(got, reference(name), atol=3e-4 if name not in RATES else 3e-3)


def native(name, timestep, start=None):
    """C MuJoCo with the element that `edit` writes."""
    spec = mujoco.MjSpec.from_string(MODEL)
    if name:
        effect = make(name, where=PLACES)
        labels = [q.name for q in effect.quantities]
        own = {place: dict(zip(labels, row, strict=True)) for place, row in zip(PLACES, TRUE[name], strict=True)}
        assert effect.edit(spec, own) is None
    spec.option.timestep = timestep
    model = spec.compile()
    data, rows = mujoco.MjData(model), [np.zeros(4)]
    data.act[:] = start if model.na else []
    for row in commands():
        data.ctrl[:] = row
        mujoco.mj_step(model, data, round(DT / timestep))
        rows.append(np.r_[data.qpos, data.qvel])
    return np.array(rows)


@pytest.mark.parametrize("name", NATIVE)
def test_is_what_it_writes_into_the_model(name):
    np.testing.assert_allclose(with_each_on()[name], native(name, TIMESTEP), atol=3e-4)


def test_lag_is_filterexact_of_fine_steps():
    """The change of the angles that the lag makes, to 5 % of its size: steps of 0.1 ms in MuJoCo against 5 ms here."""
    plain = motion(physics("together"), [theta(physics("together"))])[0]
    change = native("actuator_lag", 1e-4, commands()[0]) - native(None, 1e-4)
    got = with_each_on()["actuator_lag"] - plain
    np.testing.assert_allclose(got[:, :2], change[:, :2], atol=0.05 * np.abs(change[:, :2]).max())


@pytest.mark.slow
@pytest.mark.ci
def test_neutral_changes_no_bit():
    """Also while dry friction acts."""
    with_effects = motion(physics("together"), [theta(physics("together"), friction=f) for f in (0.0, 0.2)])
    without = motion(physics("none"), [theta(physics("none"), friction=f) for f in (0.0, 0.2)])
    assert not np.array_equal(*without)
    assert np.array_equal(with_effects, without)


@pytest.mark.slow
@EACH
def test_neutral_changes_no_bit_beside_one_other(name):
    """In programs of its own: as part of the large one, eight of nine are at neutral anyway."""
    other = make("actuator_gain" if name != "actuator_gain" else "actuator_bias", where="all")
    model = mujoco.MjModel.from_xml_string(MODEL)
    one = Physics(model, DT, ParameterSpace(), [other])
    two = Physics(model, DT, ParameterSpace(), [make(name, where=PLACES), other])
    seen = [motion(p, [np.r_[p.space.nominal[:-1], 0.7]])[0] for p in (one, two)]
    assert np.array_equal(*seen)


@pytest.mark.slow
@pytest.mark.ci
def test_two_places_are_two_effects():
    p = physics("one by one")
    apart = motion(p, [theta(p, name, v) for name, v in TRUE.items()])
    for name, got in zip(TRUE, apart, strict=True):
        np.testing.assert_allclose(got, with_each_on()[name], atol=1e-4, err_msg=name)


@pytest.mark.slow
def test_tied_values_hold_everywhere():
    tied, free = physics("tied"), physics("together")
    one = motion(tied, [theta(tied, name, v[0]) for name, v in TRUE.items()])
    two = motion(free, [theta(free, name, [v[0], v[0]]) for name, v in TRUE.items()])
    np.testing.assert_allclose(one, two, atol=1e-4)


def test_finite_over_the_whole_range():
    p = physics("together")
    corners = np.where(np.random.default_rng(0).random((WORLDS - 1, len(p.space))) < 0.5, p.space.low, p.space.high)
    assert np.isfinite(motion(p, [p.space.high, *corners])).all()


@EACH
def test_recovers_its_values(name):
    """Values of both places at once to 2 %, from the best of three starts off by up to 60 % (20 % for an order)."""
    p, true = physics("together"), np.ravel(TRUE[name])
    neutral = np.array([q.neutral for q in make(name, where="x").quantities * 2])
    free = np.flatnonzero(true != neutral)
    target = with_each_on()[name]

    def residual(points):
        """`[points, residuals]` at multiples of the distance between neutral and truth."""
        values = np.tile(neutral, (len(points), 1))
        values[:, free] += np.asarray(points) * (true - neutral)[free]
        return (motion(p, [theta(p, name, v) for v in values]) - target).reshape(len(points), -1)

    starts = np.array([0.4, 0.7, 1.6])[:, None] * np.ones(len(free))
    if name == "cogging":  # the order is found from nearby only
        starts[:, 2] = [0.8, 0.9, 1.2]
    start = starts[np.argmin((residual(starts) ** 2).sum(axis=1))]
    fit = least_squares(lambda x: residual([x])[0], start, diff_step=0.01, bounds=(0, np.inf))
    np.testing.assert_allclose(fit.x, 1.0, atol=0.02)
