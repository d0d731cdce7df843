"""Friction, drag, springs and armature against hand computations and MuJoCo C's native elements."""

import dataclasses

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from scipy.optimize import least_squares

from bayessim_mjx.effects import make
from bayessim_mjx.parameters import ParameterSpace
from bayessim_mjx.physics import Physics, control_step
from bayessim_mjx.rollout import replay

DT, MASS, WEIGHT = 0.02, 2.0, 19.62
NAMES = ("viscous_friction", "stribeck_friction", "load_friction", "asymmetric_friction", "quadratic_drag")
NAMES += ("joint_spring", "armature")
LIFT = """
<mujoco>
  <option timestep="0.005" integrator="{integrator}"/>
  <worldbody>
    <body><joint name="z" type="slide" axis="0 0 1"/><geom size=".1" mass="2" contype="0"/></body>
  </worldbody>
  <actuator><motor name="z" joint="z"/></actuator>
</mujoco>
"""
ARM = """
<mujoco>
  <option timestep="0.005"/>
  <worldbody>
    <body>
      <joint name="a" axis="0 1 0" damping=".13"/>
      <geom type="capsule" fromto="0 0 0 .5 0 0" size=".03" mass="1" contype="0"/>
      <body pos=".5 0 0">
        <joint name="b" axis="0 1 0" damping=".07"/>
        <geom type="capsule" fromto="0 0 0 .4 0 0" size=".03" mass=".5" contype="0"/>
      </body>
    </body>
  </worldbody>
  <actuator><motor name="a" joint="a"/><motor name="b" joint="b"/></actuator>
</mujoco>
"""


@dataclasses.dataclass(frozen=True)
class Bench:
    """One compiled program; which effect is active is a matter of theta."""

    physics: Physics

    def theta(self, values):
        theta = np.array(self.physics.space.nominal)
        for name, value in values.items():
            theta[self.physics.space.names.index(name)] = value
        return theta

    def run(self, values, command, qpos=0.0, qvel=0.0):
        """(qpos, qvel) `[T+1, nv]` under `command` `[T, nu]`."""
        nv = self.physics.mj_model.nv
        start = [np.broadcast_to(np.asarray(x, float), (1, nv)) for x in (qpos, qvel)]
        out = replay(self.physics, *start, np.asarray(command)[None], self.theta(values)[None])
        return np.asarray(out["qpos"][0]), np.asarray(out["qvel"][0])


def bench(xml, effects, where):
    model = mujoco.MjModel.from_xml_string(xml)
    stack = [make(e, where=w) for e in effects for w in (where if isinstance(where, list) else [where])]
    return Bench(Physics(model, DT, ParameterSpace(), stack))


@pytest.fixture(scope="module")
def lift():
    return bench(LIFT.format(integrator="Euler"), ("coulomb_friction", *NAMES), "z")


@pytest.fixture(scope="module")
def arm():
    return bench(ARM, ("coulomb_friction", *NAMES), ("a", "b"))


def push(force, steps=40):
    """Commands that carry the weight and push with `force` N on top of it."""
    return np.full((steps, 1), WEIGHT + force)


def waves(joints, steps=40):
    t = DT * np.arange(steps)[:, None]
    return np.concatenate([3 * np.sin(9 * t + i) + 2 * np.sin(23 * t) for i in range(joints)], axis=1)


@pytest.mark.slow
@pytest.mark.ci
def test_neutral_changes_no_bit(arm):
    """The whole stack at neutral against no effect at all, and against Coulomb friction alone."""
    command = waves(2)
    for effects, values in (((), {}), (("coulomb_friction",), {"a.coulomb_friction.level": 0.7})):
        bare = bench(ARM, effects, ("a", "b")).run(values, command, qvel=(1.0, -2.0))
        full = arm.run(values, command, qvel=(1.0, -2.0))
        assert all(np.array_equal(one, two) for one, two in zip(bare, full, strict=True))


@pytest.mark.slow
@pytest.mark.ci
def test_two_places_are_two_single_effects(arm):
    values = {f"{j}.{k}": v for j in "ab" for k, v in ACTIVE.items()} | {"b.viscous_friction.damping": 0.3}
    singles = bench(ARM, ("coulomb_friction", *NAMES), ["a", "b"])
    one, two = (x.run(values, waves(2)) for x in (arm, singles))
    np.testing.assert_allclose(one[0], two[0], atol=2e-3)  # dry friction settles in another order
    values = {k: v for k, v in values.items() if not k.endswith(("level", "excess", "motor", "external"))}
    one, two = (x.run(values, 3 * waves(2)) for x in (arm, singles))
    np.testing.assert_allclose(one[0], two[0], atol=1e-4)


ACTIVE = {
    "coulomb_friction.level": 0.1,
    "viscous_friction.damping": 0.1,
    "stribeck_friction.level": 0.1,
    "stribeck_friction.excess": 0.1,
    "load_friction.motor": 0.1,
    "load_friction.external": 0.05,
    "quadratic_drag.coefficient": 0.02,
    "joint_spring.stiffness": 1.0,
    "joint_spring.cubic": 0.5,
    "joint_spring.rest": 0.3,
    "armature.inertia": 0.05,
}


def in_c(spec, command, qvel):
    """MuJoCo C: qpos `[T+1, nq]`."""
    model = spec.compile()
    data = mujoco.MjData(model)
    data.qvel[:] = qvel
    rows = [data.qpos.copy()]
    for u in command:
        data.ctrl[:] = u
        mujoco.mj_step(model, data, nstep=round(DT / model.opt.timestep))
        rows.append(data.qpos.copy())
    return np.asarray(rows)


NATIVE = [
    ("viscous_friction", {"a": {"damping": 0.8}, "b": {"damping": 0.2}}),
    ("armature", {"a": {"inertia": 0.3}, "b": {"inertia": 0.1}}),
    ("joint_spring", {"a": {"stiffness": 6.0, "cubic": 0.0, "rest": -0.4}}),
]


@pytest.mark.parametrize(("name", "values"), NATIVE, ids=[n for n, _ in NATIVE])
@pytest.mark.slow
@pytest.mark.ci
def test_equals_mujoco_with_the_native_element(arm, name, values):
    spec = mujoco.MjSpec.from_string(ARM)
    assert make(name, where=tuple(values)).edit(spec, values) is None
    named = {f"{place}.{name}.{k}": v for place, own in values.items() for k, v in own.items()}
    want, got = in_c(spec, waves(2), (1.0, -2.0)), arm.run(named, waves(2), qvel=(1.0, -2.0))[0]
    np.testing.assert_allclose(got, want, atol=5e-5)
    assert np.abs(want - in_c(mujoco.MjSpec.from_string(ARM), waves(2), (1.0, -2.0))).max() > 0.1


@pytest.mark.skipif(not hasattr(mujoco.MjModel, "jnt_stiffnesspoly"), reason="polynomials came with MuJoCo 4")
def test_a_cubic_spring_equals_the_polynomial_of_mujoco_4(arm):
    spec = mujoco.MjSpec.from_string(ARM)
    spec.joint("b").stiffness = [0, 0, 3.0]
    want, got = in_c(spec, waves(2), (3.0, -2.0)), arm.run({"b.joint_spring.cubic": 3.0}, waves(2), qvel=(3.0, -2.0))[0]
    np.testing.assert_allclose(got, want, atol=1e-4)
    assert np.abs(want - in_c(mujoco.MjSpec.from_string(ARM), waves(2), (3.0, -2.0))).max() > 0.1


def test_drag_of_coupled_joints_is_the_implicit_step(arm):
    """(M + dt (D + C |w|)) dw/dt = u - bias - (D + C |w|) w, solved at once in float64."""
    drag, command = np.array([0.3, 0.2]), waves(2)
    model = mujoco.MjModel.from_xml_string(ARM)
    data, dt, rows = mujoco.MjData(model), model.opt.timestep, []
    data.qvel[:] = 5.0, -4.0
    for u in np.repeat(command, round(DT / dt), axis=0):
        mujoco.mj_forward(model, data)
        inertia, damping = np.zeros((2, 2)), model.dof_damping + drag * np.abs(data.qvel)
        for row, unit in zip(inertia, np.eye(2), strict=True):
            mujoco.mj_mulM(model, data, row, unit)
        force = u - data.qfrc_bias - damping * data.qvel
        data.qvel[:] += dt * np.linalg.solve(inertia + dt * np.diag(damping), force)
        data.qpos[:] += dt * data.qvel
        rows.append(data.qpos.copy())
    values = {f"{j}.quadratic_drag.coefficient": c for j, c in zip("ab", drag, strict=True)}
    got = arm.run(values, command, qvel=(5.0, -4.0))[0][1:]
    np.testing.assert_allclose(got, rows[round(DT / dt) - 1 :: round(DT / dt)], atol=1e-3)


def test_armature_renews_the_derived_constants(arm):
    values = {"a": {"inertia": 0.3}, "b": {"inertia": 0.1}}
    theta = arm.theta({f"{k}.armature.inertia": v["inertia"] for k, v in values.items()})
    world = jax.jit(arm.physics.world)(theta)
    spec = mujoco.MjSpec.from_string(ARM)
    make("armature", where="all").edit(spec, values)
    want, got = spec.compile(), arm.physics.model_of(world)
    for name in ("dof_armature", "dof_M0", "dof_invweight0", "body_invweight0", "actuator_acc0"):
        np.testing.assert_allclose(getattr(got, name), getattr(want, name), rtol=1e-4, atol=1e-6, err_msg=name)
    assert got.stat.meaninertia == pytest.approx(want.stat.meaninertia, rel=1e-4)


@pytest.mark.slow
def test_drag_of_a_coasting_body_is_exact(lift):
    """1 / w = 1 / w0 + c t / m."""
    w = lift.run({"z.quadratic_drag.coefficient": 0.5}, push(0.0), qvel=-3.0)[1][:, 0]
    np.testing.assert_allclose(w, -1 / (1 / 3 + 0.5 / MASS * DT * np.arange(41)), rtol=1e-4)


@pytest.mark.slow
@pytest.mark.ci
def test_any_damping_and_drag_is_stable(lift):
    for key in ("z.viscous_friction.damping", "z.quadratic_drag.coefficient"):
        w = lift.run({key: 1e6}, push(0.0), qvel=3.0)[1][:, 0]
        assert (np.diff(w) <= 1e-6).all() and (w >= -1e-6).all() and w[-1] < 0.01
    rk4 = bench(LIFT.format(integrator="RK4"), ("viscous_friction",), "z")
    assert abs(rk4.run({"z.viscous_friction.damping": 1e6}, push(0.0), qvel=3.0)[1][-1, 0]) < 1e-3
    w = rk4.run({"z.viscous_friction.damping": 1.0}, push(0.0), qvel=3.0)[1][:, 0]
    np.testing.assert_allclose(w, 3 * np.exp(-DT * np.arange(41) / MASS), rtol=2e-3)


def holds(lift, values, force):
    return np.abs(lift.run(values, push(force))[0]).max() < 1e-6


@pytest.mark.slow
def test_stribeck_holds_up_to_level_and_excess_and_slides_as_its_curve_says(lift):
    own = {"z.stribeck_friction.level": 3.0, "z.stribeck_friction.excess": 2.0, "z.stribeck_friction.speed": 0.5}
    for sign in (-1, 1):
        assert holds(lift, own, sign * 4.95) and not holds(lift, own, sign * 5.1)
    both = own | {"z.coulomb_friction.level": 1.0}  # two dry frictions at one joint add up
    assert holds(lift, both, 5.9) and not holds(lift, both, 6.1)
    w = lift.run(own | {"z.viscous_friction.damping": 6.0}, push(-6.0, 200))[1][-1, 0]
    assert 3.0 + 2.0 * np.exp(-((w / 0.5) ** 2)) + 6.0 * abs(w) == pytest.approx(6.0, rel=1e-3)


@pytest.mark.parametrize(("motor", "external"), [(0.2, 0.0), (0.0, 0.3), (0.1, 0.2)])
def test_the_hold_range_grows_with_the_load(lift, motor, external):
    """Held while |u - W| <= cm |u| + ce W: from W (1 - ce) / (1 + cm) to W (1 + ce) / (1 - cm)."""
    own = {"z.load_friction.motor": motor, "z.load_friction.external": external}
    low, high = WEIGHT * (1 - external) / (1 + motor), WEIGHT * (1 + external) / (1 - motor)
    for force, held in ((low * 1.005, 1), (low * 0.99, 0), (high * 0.995, 1), (high * 1.01, 0)):
        assert holds(lift, own, force - WEIGHT) == bool(held)
    force = high + 4.0  # lifts with F - W - cm F - ce W
    w = lift.run(own, push(force - WEIGHT))[1][-1, 0]
    assert w == pytest.approx((force * (1 - motor) - WEIGHT * (1 + external)) / MASS * 40 * DT, rel=1e-3)


def test_asymmetric_friction_by_direction(lift):
    own = dict(level_forward=3.0, level_backward=1.0, viscous_forward=8.0, viscous_backward=4.0)
    own = {f"z.asymmetric_friction.{k}": v for k, v in own.items()}
    assert holds(lift, own, 2.95) and not holds(lift, own, 3.1)
    assert holds(lift, own, -0.95) and not holds(lift, own, -1.1)
    assert lift.run(own, push(5.0, 200))[1][-1, 0] == pytest.approx((5.0 - 3.0) / 8.0, rel=1e-3)
    assert lift.run(own, push(-5.0, 200))[1][-1, 0] == pytest.approx(-(5.0 - 1.0) / 4.0, rel=2e-3)


HIDDEN = {
    "viscous_friction": {"damping": 0.7},
    "stribeck_friction": {"level": 0.8, "excess": 0.6, "speed": 0.3},
    "load_friction": {"motor": 0.12, "external": 0.2},
    "asymmetric_friction": {
        "level_forward": 0.8, "level_backward": 0.4, "viscous_forward": 0.3, "viscous_backward": 0.9,
    },
    "quadratic_drag": {"coefficient": 0.6},
    "joint_spring": {"stiffness": 6.0, "cubic": 5.0, "rest": 0.2},
    "armature": {"inertia": 0.6},
}  # fmt: skip


@pytest.mark.parametrize("name", NAMES)
def test_recovers_hidden_values(lift, name):
    t = DT * np.arange(40)[:, None]
    command = WEIGHT + 14 * np.sin(11 * t + 0.8) + 5 * np.sin(29 * t)
    labels, truth = zip(*((f"z.{name}.{k}", v) for k, v in HIDDEN[name].items()), strict=True)

    def residual(x):
        motion = lift.run(dict(zip(labels, x, strict=True)), command)
        return np.concatenate([(m - s)[:, 0] for m, s in zip(motion, logged, strict=True)])

    logged = lift.run(dict(zip(labels, truth, strict=True)), command)
    start = 0.5 * np.asarray(truth)
    fit = least_squares(residual, start, bounds=(1e-3, 20.0), diff_step=1e-2, x_scale=start, xtol=1e-6)
    np.testing.assert_allclose(fit.x, truth, rtol=0.02)


@pytest.mark.slow
def test_the_gradient_at_neutral_is_that_of_the_law():
    """dv/dt = -(level + b w) / m while sliding: the tangent in the level is not lost at 0."""
    physics = bench(LIFT.format(integrator="Euler"), ("asymmetric_friction",), "z").physics

    def speed(theta):
        world, _ = control_step(physics, physics.world(theta, qvel=jnp.array([2.0])), jnp.array([WEIGHT]))
        return world.qvel[0]

    np.testing.assert_allclose(jax.jit(jax.grad(speed))(jnp.zeros(4)), [-0.01, 0, -0.02, 0], atol=1e-4)
