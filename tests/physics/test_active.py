"""Effects that no world of a call has are left out by branches: the same motion."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from bayessim_mjx.diagnosis.fitting.simulator import Centred
from bayessim_mjx.effects import load
from bayessim_mjx.parameters import ParameterSpace
from bayessim_mjx.physics import Drive, Physics, control_step
from bayessim_mjx.physics.pushed import apart, together

ARM = """<mujoco><option timestep="0.005" integrator="implicitfast"/>
  <default><geom type="capsule" size=".03" contype="0" conaffinity="0"/></default><worldbody>
  <body><joint name="shoulder" axis="0 1 0" damping=".1"/><geom fromto="0 0 0 .3 0 0"/>
    <body pos=".3 0 0"><joint name="elbow" axis="0 1 0" damping=".1"/><geom fromto="0 0 0 .2 0 0"/></body></body>
  </worldbody>
  <actuator><motor name="s" joint="shoulder"/><motor name="e" joint="elbow"/></actuator></mujoco>"""
# one of each hook: the command, the actuator, a force, a force with a memory, the sensor
ON = {
    "actuator_delay": ("s", "e"), "actuator_deadband": ("s", "e"), "coulomb_friction": ("shoulder", "elbow"),
    "backlash": ("shoulder", "elbow"), "sensor_delay": ("shoulder", "elbow"),
}  # fmt: skip


@pytest.fixture(scope="module")
def physics():
    model = mujoco.MjModel.from_xml_string(ARM)
    stack = [load(name)(where) for name, where in ON.items()]
    return Physics(model, 0.01, ParameterSpace(()), (*stack, Centred()))


def motion(physics, theta, active):
    """qpos and what sensors show, over 20 control steps."""
    drive = Drive(active=active)

    def step(world, command):
        world, _ = control_step(physics, world, command, drive)
        return world, (world.qpos, world.measurement["qpos"])

    commands = 2.0 * jnp.sin(jnp.arange(20.0))[:, None] * jnp.array([1.0, -0.5])
    return jax.lax.scan(step, physics.world(theta, jnp.array([0.3, -0.4])), commands)[1]


@pytest.fixture(scope="module")
def both(physics):
    """The compiled programs: all hooks computed, and those of active effects; many worlds, one set of branches."""
    plain = jax.jit(jax.vmap(lambda theta: motion(physics, theta, None)))
    some = jax.jit(jax.vmap(lambda theta, active: motion(physics, theta, active), in_axes=(0, None)))
    return plain, some


def middle(physics, *names):
    theta = np.array(physics.neutral)
    for i, p in enumerate(physics.space.parameters):
        if p.name.split(".")[1] in names:
            theta[i] = p.low + 0.3 * (p.high - p.low)
    return theta


def test_what_acts_is_what_is_not_neutral(physics):
    thetas = np.stack([physics.neutral, middle(physics, "backlash"), middle(physics, *ON)])
    centring = [False] * len(ON) + [True]  # without a number to be neutral it always acts
    assert physics.acting(thetas).tolist() == [centring, [n == "backlash" for n in ON] + [True], [True] * 6]


@pytest.mark.parametrize("names", [(), *[(name,) for name in ON], ("actuator_delay", "coulomb_friction")])
@pytest.mark.slow
@pytest.mark.ci
def test_the_motion_is_the_same(physics, both, names):
    """Both are programs of their own, and a compiler may fuse a product and a sum in one of them: to rounding."""
    thetas = np.stack([physics.neutral, middle(physics, *names), 0.5 * (physics.neutral + middle(physics, *names))])
    plain, some = both
    expected, got = plain(thetas), some(thetas, physics.acting(thetas).any(0))
    for a, b in zip(expected, got, strict=True):
        np.testing.assert_allclose(a, b, rtol=0, atol=1e-6)  # 8 roundings of a number near 1
    assert (not names) == np.array_equal(expected[1][0], expected[1][1])  # these effects do act


def test_what_is_not_active_is_not_computed(physics, both):
    thetas, neutral = (np.stack([one] * 3) for one in (middle(physics, *ON), physics.neutral))
    none = both[1](thetas, np.array([False] * len(ON) + [True]))
    np.testing.assert_array_equal(none[0], both[0](neutral)[0])


def test_a_branch_stays_a_branch_for_many_worlds(physics):
    active = np.ones(6, bool)
    run = jax.vmap(lambda theta, on: motion(physics, theta, on), in_axes=(0, None))
    program = str(jax.make_jaxpr(run)(np.stack([physics.neutral] * 2), active))
    assert program.count(" cond[") >= len(ON)


def test_the_forces_of_a_timestep_are_put_together_and_taken_apart_again(physics):
    names = [effect.name for effect in physics.effects]
    pushing = [names.index("coulomb_friction"), names.index("backlash")]
    rows = np.zeros((len(names), 2), np.float32)
    rows[pushing] = [[1.0, 2.0], [3.0, 4.0]]
    each = apart(physics, jnp.asarray(rows))
    assert [row.tolist() for row in each if np.any(row)] == [[1.0, 2.0], [3.0, 4.0]] and len(each) < len(names)
    np.testing.assert_array_equal(together(physics, each), rows)


def test_what_follows_from_inertias_is_renewed_once_behind_all_that_change_them():
    """In whatever order they stand; a transmission, which hides the armature, comes after it."""
    stack = [load(n)(w) for n, w in (("backlash", ("elbow",)), ("armature", ("elbow",)), ("payload", ("fore",)))]
    xml = ARM.replace('<body pos=".3 0 0">', '<body name="fore" pos=".3 0 0">')
    physics = Physics(mujoco.MjModel.from_xml_string(xml), 0.02, ParameterSpace(), stack)
    theta = np.array(physics.neutral)
    names = list(physics.space.names)
    theta[names.index("elbow.armature.inertia")], theta[names.index("fore.payload.mass")] = 0.3, 0.5
    theta[names.index("elbow.backlash.gap")] = 0.02
    got = physics.model_of(jax.jit(physics.world)(jnp.asarray(theta)))
    spec = mujoco.MjSpec.from_string(xml)
    spec.joint("elbow").armature = 0.3
    load("payload")(("fore",)).edit(spec, {"fore": {"mass": 0.5, "com_x": 0.0, "com_y": 0.0, "com_z": 0.0}})
    want = spec.compile()
    for name in ("dof_M0", "dof_invweight0", "actuator_acc0"):
        np.testing.assert_allclose(getattr(got, name), getattr(want, name), rtol=1e-4, err_msg=name)
    assert got.body_subtreemass[0] == pytest.approx(want.body_subtreemass[0], rel=1e-5)
    still = physics.model_of(jax.jit(physics.world)(jnp.asarray(physics.neutral)))
    for name in ("dof_M0", "body_invweight0", "body_subtreemass"):  # the compiler's own numbers, to the bit
        np.testing.assert_array_equal(getattr(still, name), getattr(physics.model, name), err_msg=name)
