"""The control step against `mjx.step` and MuJoCo C; what a World carries; what compiles once."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from bayessim_mjx.effects import make
from bayessim_mjx.effects.support.motion import Motion
from bayessim_mjx.parameters import Parameter, ParameterSpace
from bayessim_mjx.physics import Physics, begin, control_step, mjx
from bayessim_mjx.registry import make as env_make

BALL = '<body pos="1 0 .12"><freejoint/><geom type="sphere" size=".1" mass="1"/></body>'
XML = """
<mujoco>
  <option timestep="0.005" integrator="{integrator}" iterations="4" ls_iterations="8">
    <flag contact="{contact}"/>
  </option>
  <worldbody>
    <geom name="floor" type="plane" size="1 1 .1"/>
    <body name="arm" pos="0 0 .3">
      <joint name="hinge" axis="0 1 0" damping="0.05"/>
      <geom name="arm" type="capsule" fromto="0 0 0 .4 0 0" size=".03" mass="0.5"/>
      <site name="tip" pos=".4 0 0"/>
    </body>
    {ball}
  </worldbody>
  <actuator><motor name="motor" joint="hinge" ctrlrange="-1 1"/></actuator>
  <sensor><accelerometer site="tip"/><jointvel joint="hinge"/><framepos objtype="site" objname="tip"/></sensor>
</mujoco>
"""
MASS = Parameter("arm_mass_mult", 1.0, 0.5, 2.0, attribute="mass", target="arm", kind="body")


def model_of(integrator="Euler", contact=False):
    """An arm on a hinge, with sensors; with `contact` also a ball on the floor (slow to compile)."""
    flag, ball = ("enable", BALL) if contact else ("disable", "")
    return mujoco.MjModel.from_xml_string(XML.format(integrator=integrator, contact=flag, ball=ball))


def physics(integrator="Euler", space=None, contact=False, **kwargs):
    model = model_of(integrator, contact)
    return Physics(model, 0.02, ParameterSpace() if space is None else space, **kwargs)


def test_timesteps_in_a_row_are_those_of_a_loop():
    """The same motion to rounding, and no loop over timesteps in the program."""
    loop, row = (
        physics(effects=[make("viscous_friction", where="hinge")]),
        physics(effects=[make("viscous_friction", where="hinge")], unroll=True),
    )
    ends, loops = [], []
    for p in (loop, row):
        step = lambda w, p=p: control_step(p, w, jnp.array([0.4]))[0]  # noqa: E731
        world = p.world(jnp.array([0.02]))
        loops.append(jax.jit(step).lower(world).as_text().count("stablehlo.while"))
        ends.append(jax.lax.fori_loop(0, 20, lambda _, w, step=step: step(w), world))
    assert loops[0] == loops[1] + 1
    np.testing.assert_allclose(ends[0].qpos, ends[1].qpos, rtol=1e-5)
    assert abs(float(ends[0].qpos[0])) > 0.1
    assert env_make("Pendulum", unroll=True).physics.unroll and not env_make("Pendulum").physics.unroll


@pytest.mark.slow
@pytest.mark.ci
@pytest.mark.parametrize("integrator", ["Euler", "implicitfast"])
def test_without_effects_it_is_mjx_step_repeated(integrator):
    """Ten control steps of four sub-steps, the ball in contact: to rounding (the two programs fuse differently)."""
    p = physics(integrator, contact=True)
    data = p.template.replace(ctrl=jnp.array([0.4]))
    world = p.world(jnp.zeros(0))
    ours, theirs = jax.jit(lambda w: control_step(p, w, jnp.array([0.4]))), jax.jit(lambda d: mjx.step(p.model, d))
    for _ in range(10):
        world, last = ours(world)
        for _ in range(4):
            data = theirs(data)
    for name in ("qpos", "qvel", "time", "sensordata", "qfrc_constraint", "xpos"):
        np.testing.assert_allclose(getattr(last, name), getattr(data, name), rtol=1e-5, atol=1e-5, err_msg=name)
    np.testing.assert_allclose(world.warmstart, data.qacc_warmstart, rtol=1e-4, atol=1e-4)
    assert world.time == pytest.approx(0.2)
    assert np.abs(last.sensordata).max() > 0.1


def test_agrees_with_mujoco_c():
    p = physics(contact=True)
    data, world = mujoco.MjData(p.mj_model), p.world(jnp.zeros(0))
    step = jax.jit(lambda w, c: control_step(p, w, c)[0])
    for command in np.random.default_rng(0).uniform(-3, 3, (25, 1)):  # beyond ctrlrange: both clip
        world = step(world, jnp.float32(command))
        data.ctrl[:] = command
        mujoco.mj_step(p.mj_model, data, nstep=4)
    np.testing.assert_allclose(world.qpos, data.qpos, atol=1e-4)
    np.testing.assert_allclose(world.qvel, data.qvel, atol=1e-3)


def test_only_changed_fields_travel():
    p = physics(space=ParameterSpace([MASS]))
    world = p.world(jnp.array([1.5]))
    assert "body_mass" in world.fields
    assert not {"geom_friction", "qpos0", "opt.gravity"} & set(world.fields)
    model = p.model_of(world)
    assert model.body_mass[1] == pytest.approx(0.75)
    assert model.geom_friction is p.model.geom_friction
    assert physics().world(jnp.zeros(0)).fields == {}


def test_nested_fields_are_found_and_put_back():
    p = physics(effects=[make("gravity_tilt", where="world")])
    world = p.world(jnp.array([0.0, 0.1]))
    assert set(world.fields) == {"opt.gravity"}
    np.testing.assert_allclose(
        p.model_of(world).opt.gravity, 9.81 * np.array([np.sin(0.1), 0, -np.cos(0.1)]), atol=1e-5
    )


def test_velocities_are_clipped_after_the_position_moved():
    p = physics(max_qvel=2.0)
    step = jax.jit(lambda w: control_step(p, w, jnp.zeros(1))[0])
    for sign in (1, -1):
        # hangs down, swings
        world = step(p.world(jnp.zeros(0), qpos=np.array([np.pi / 2]), qvel=np.array([sign * 9.0])))
        assert world.qvel[0] == pytest.approx(sign * 2.0, abs=0.2)
        # 9 rad/s in the first sub-step, 2 rad/s in the other three
        assert world.qpos[0] - np.pi / 2 == pytest.approx(sign * 0.005 * (9 + 3 * 2), abs=5e-3)


def test_new_values_do_not_retrace_and_worlds_batch():
    p = physics(space=ParameterSpace([MASS]), effects=[make("coulomb_friction", where="hinge")])
    traces = []

    @jax.jit
    def run(thetas, commands):
        traces.append(1)
        worlds = jax.vmap(p.world)(thetas)
        return jax.vmap(lambda w, c: control_step(p, w, c)[0])(worlds, commands)

    rng = np.random.default_rng(0)
    for _ in range(3):
        theta = np.c_[rng.uniform(0.5, 2, 3), rng.uniform(0, 1, 3)].astype(np.float32)
        out = run(theta, np.float32(rng.uniform(-1, 1, (3, 1))))
    assert len(traces) == 1
    assert out.qpos.shape == (3, 1)
    assert np.ptp(out.qvel[:, 0]) > 0


def test_refusals():
    model = model_of()
    with pytest.raises(ValueError, match=r"0.012 s.*0.005"):
        Physics(model, 0.012, ParameterSpace())
    with pytest.raises(ValueError, match=r"theta has shape \(2,\), expected \(0,\)"):
        physics().world(jnp.zeros(2))
    with pytest.raises(ValueError, match=r"qvel has shape \(3,\), expected \(1,\)"):
        physics().world(jnp.zeros(0), qvel=np.zeros(3))


def test_a_start_in_a_log_remembers_the_commands_before_it():
    """The motor answers a control step late: begun in the middle, the arm moves as the one never stopped."""
    p = physics(effects=[make("actuator_delay", where="motor")])
    commands = jnp.float32([[0.4], [-0.6], [0.9], [0.0]])

    @jax.jit
    def moved():
        def body(world, command):
            return control_step(p, world, command)[0], (world.qpos, world.qvel)

        theta = jnp.float32([0.02])
        end, (qpos, qvel) = jax.lax.scan(body, p.world(theta), commands)
        each = jnp.repeat(commands[:, None], p.substeps, axis=1)
        again, forgetful = (
            body(begin(p, theta, Motion(qpos, qvel, past, 3)), commands[3])[0].qvel for past in (each, 0 * each)
        )
        return end.qvel, again, forgetful

    whole, again, forgetful = (float(x[0]) for x in moved())
    assert again == pytest.approx(whole, abs=1e-5)
    assert abs(forgetful - whole) > 0.05


FOUR_BAR = """
<mujoco><option timestep="0.002" integrator="implicitfast"/>
  <default><geom type="capsule" size="0.012" contype="0" conaffinity="0"/><joint axis="0 1 0" damping="0.02"/></default>
  <worldbody>
    <body><joint armature="0.01"/><geom fromto="0 0 0 0 0 0.15" mass="0.3"/>
      <body name="coupler" pos="0 0 0.15"><joint name="coupler"/><geom fromto="0 0 0 0.3 0 0.05" mass="0.3"/></body>
    </body>
    <body name="rocker" pos="0.3 0 0"><joint name="rocker"/><geom fromto="0 0 0 0 0 0.2" mass="0.3"/></body>
    <body pos="1 0 0"><joint name="wheel"/><geom fromto="0 0 0 0 0 0.1" mass="0.1"/></body>
  </worldbody>
  <tendon><fixed name="belt"><joint joint="wheel" coef="2"/><joint joint="rocker" coef="-1"/></fixed></tendon>
  <equality>
    <connect body1="coupler" body2="rocker" anchor="0.3 0 0.05" solref="0.004 1"/>
    <tendon tendon1="belt" solimp="0.99 0.999 0.0001" solref="0.004 1"/>
  </equality>
  <actuator><motor joint="rocker"/></actuator></mujoco>
"""


def test_closed_loops_move_as_in_mujoco():
    """Nothing but equality constraints: one linear solution in the place of the solver's iterations."""
    model = mujoco.MjModel.from_xml_string(FOUR_BAR)
    data, p = mujoco.MjData(model), Physics(model, 0.02, ParameterSpace())
    step, world = jax.jit(lambda w, u: control_step(p, w, u)[0]), p.world(jnp.zeros(0))
    for k in range(20):
        data.ctrl[0] = 0.5 * np.sin(0.3 * k)
        world = step(world, jnp.asarray(data.ctrl, jnp.float32))
        mujoco.mj_step(model, data, p.substeps)
    assert np.ptp(data.qpos) > 0.5
    np.testing.assert_allclose(world.qpos, data.qpos, atol=1e-4)
    np.testing.assert_allclose(world.qvel, data.qvel, atol=1e-3)
