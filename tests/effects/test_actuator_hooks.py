"""The effects of actuators without a simulation: numbers by hand, what is written into a model, what is refused."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from bayessim_mjx.effects import make
from bayessim_mjx.errors import UserError

XML = """
<mujoco>
  <worldbody>
    <body><joint name="x" axis="0 1 0"/><geom size=".1" mass="1"/></body>
    <body><joint name="y" axis="0 1 0"/><geom size=".1" mass="1"/></body>
  </worldbody>
  <actuator>
    <motor name="motor" joint="x" forcerange="-3 2"/>
    <position name="servo" joint="y" kp="6" dampratio="1"/>
  </actuator>
</mujoco>
"""
MODEL = mujoco.MjModel.from_xml_string(XML)
TIMESTEP = 0.002
FOLLOWERS = pytest.mark.parametrize("name", ["actuator_lag", "rate_limit"])
NOT_NATIVE = ("actuator_deadband", "cogging", "effort_loss", "rate_limit", "speed_torque_limit")
NATIVE = ("actuator_bias", "actuator_gain", "actuator_lag", "actuator_saturation")


def followed(name, values, *control_steps):
    """What the actuators get, `[all sub-steps, 2]`, of commands `[substeps, 2]`."""
    effect, rows = make(name, where=("motor", "servo")), []
    at = effect.bind(MODEL, TIMESTEP, 4)
    memory = effect.init(at)
    for command in control_steps:
        memory, got = effect.on_command(at, memory, jnp.asarray(command, jnp.float32), jnp.asarray(values, jnp.float32))
        rows.append(got)
    return jnp.concatenate(rows)


STEP = [[[0, 5], [0, 5], [1, 5], [1, 5]], [[1, 5], [1, 5], [1, 1], [1, 1]]]  # across two control steps


def test_lag_by_hand():
    """T = one sub-step: the mean over the k-th sub-step after a unit step is 1 - exp(-k) + exp(-k - 1). T = 0: off."""
    got = followed("actuator_lag", [TIMESTEP, 0.0], *STEP)
    k = np.arange(6)
    np.testing.assert_allclose(got[:, 0], [0, 0, *(1 - np.exp(-k) + np.exp(-k - 1.0))], atol=1e-6)
    assert np.array_equal(got[:, 1], np.concatenate(STEP)[:, 1])


def test_rate_limit_by_hand():
    """A unit step in 2.5 sub-steps: u ends at .4, .8, 1, and is there for the second half of the third; down from 5."""
    got = followed("rate_limit", [2.5 * TIMESTEP, 2.5 * TIMESTEP], *STEP)
    np.testing.assert_allclose(got[:, 0], [0, 0, 0.2, 0.6, 0.95, 1, 1, 1], atol=1e-6)
    np.testing.assert_allclose(got[:, 1], [5, 5, 5, 5, 5, 5, 4.8, 4.4], atol=1e-6)


@FOLLOWERS
def test_followers_begin_at_the_first_command(name):
    got = followed(name, [0.1, 0.1], [[3, -2]] * 4, [[3, -2]] * 4)
    np.testing.assert_allclose(got, [[3, -2]] * 8, atol=1e-6)


@FOLLOWERS
def test_followers_have_a_slope_at_neutral(name):
    """Continuous, and differentiable from the right: a fit may start at "off"."""

    def total(value):
        return jnp.sum(followed(name, jnp.stack([value, value]), *STEP)[:, 0])

    value, slope = jax.jit(jax.value_and_grad(total))(jnp.float32(0.0))
    assert slope < -1
    assert total(jnp.float32(1e-4)) - value == pytest.approx(1e-4 * float(slope), rel=1e-2)


def written(name, values):
    spec = mujoco.MjSpec.from_string(XML)
    assert make(name, where=tuple(values)).edit(spec, values) is None
    return spec.compile()


def test_gain_scales_the_damping_of_a_damping_ratio():
    model = written("actuator_gain", {"servo": {"gain": 0.5}})
    np.testing.assert_allclose(model.actuator_gainprm[1], 0.5 * MODEL.actuator_gainprm[1])
    np.testing.assert_allclose(model.actuator_biasprm[1], 0.5 * MODEL.actuator_biasprm[1])
    assert MODEL.actuator_biasprm[1, 2] < 0
    np.testing.assert_array_equal(model.actuator_gainprm[0], MODEL.actuator_gainprm[0])


def test_saturation_stays_inside_the_old_range():
    model = written("actuator_saturation", {"motor": {"inverse_limit": 0.4}, "servo": {"inverse_limit": 0.0}})
    np.testing.assert_allclose(model.actuator_forcerange[0], [-2.5, 2.0])
    assert not model.actuator_forcelimited[1]


def test_bias_comes_after_the_limit():
    model = written("actuator_bias", {"motor": {"bias": 0.5}})
    assert model.actuator_biasprm[0, 0] == 0.5 and model.actuator_biastype[0] == mujoco.mjtBias.mjBIAS_AFFINE
    np.testing.assert_allclose(model.actuator_forcerange[0], [-2.5, 2.5])


def test_lag_is_an_activation():
    model = written("actuator_lag", {"all": {"time_constant": 0.05}})
    assert model.na == 2 and (model.actuator_dynprm[:, 0] == 0.05).all()
    assert written("actuator_lag", {"motor": {"time_constant": 0.0}}).na == 0


def test_what_cannot_be_written_is_said():
    for name in NOT_NATIVE:
        assert "MuJoCo" in make(name, where="motor").edit(mujoco.MjSpec.from_string(XML), {"motor": {}})
    spec = mujoco.MjSpec.from_string(XML.replace("<position", '<position timeconst=".1"'))
    assert "servo has an activation" in make("actuator_lag", where="all").edit(spec, {"all": {"time_constant": 0.1}})
    spec = mujoco.MjSpec.from_string(XML.replace("<motor", "<muscle"))
    assert "motor is a muscle" in make("actuator_gain", where="all").edit(spec, {"all": {"gain": 0.5}})


@pytest.mark.parametrize("name", [*NATIVE, *NOT_NATIVE])
def test_refuses_an_unknown_place(name):
    with pytest.raises(UserError, match=f"{name}: no actuator 'moto' in the model; .*motor"):
        make(name, where="moto").bind(MODEL, TIMESTEP, 4)
    with pytest.raises(UserError, match=f"{name}: no actuator 'x' in the model; .*motor, servo"):
        make(name, where=("motor", "x")).bind(MODEL, TIMESTEP, 4)


def test_dead_band_refuses_a_muscle():
    model = mujoco.MjModel.from_xml_string(XML.replace("<motor", '<muscle lengthrange="0 1"'))
    with pytest.raises(UserError, match="actuator_deadband: actuator 'motor' has no fixed gain"):
        make("actuator_deadband", where="all").bind(model, TIMESTEP, 4)
