"""Gains of a declared controller: the law itself, a step with it, and where they are on offer."""

import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from bayessim_mjx import effects
from bayessim_mjx.diagnosis.fitting import candidates, scales
from bayessim_mjx.parameters import ParameterSpace
from bayessim_mjx.physics import Drive, Physics, control_step, controllers
from tests.diagnosis.recordings import PENDULUM, record, sines

DECLARED = {"law": "position", "kp": 6.0, "kd": 0.4}


def stepped(factors: dict[str, float], gains: dict[str, float]) -> np.ndarray:
    """Position and velocity after a control step under a law with these gains, and effects with these factors."""
    model = mujoco.MjModel.from_xml_string(PENDULUM)
    own = [effects.make(name, where="motor") for name in ("controller_stiffness", "controller_damping")]
    physics = Physics(model, 0.01, ParameterSpace(), own)
    law = controllers.read({"controller": DECLARED | gains}, model, ("motor",), "log")
    theta = jnp.array([factors.get("kp", 1.0), factors.get("kd", 1.0)])
    world = physics.world(theta, jnp.array([0.3]), jnp.array([1.0]))
    world, _ = control_step(physics, world, jnp.array([0.8]), Drive(law=law))
    return np.concatenate([world.qpos, world.qvel])


@pytest.mark.parametrize("gain", ["kp", "kd"])
def test_a_factor_is_another_gain_of_the_law(gain: str):
    other = stepped({}, {gain: 0.35 * DECLARED[gain]})
    assert np.allclose(stepped({gain: 0.35}, {}), other, rtol=1e-6) and not np.allclose(
        stepped({}, {}), other, rtol=1e-4
    )


def test_they_are_on_offer_where_logs_declare_a_controller():
    model, kinds = mujoco.MjModel.from_xml_string(PENDULUM), candidates.kinds_of("all")
    for declared, expected in ((DECLARED, {"controller_stiffness", "controller_damping"}), (None, set())):
        logs = [record(PENDULUM, sines((0.9,), seed=1), name="run.npz", seed=1, controller=declared)]
        stack, _ = candidates.stack(kinds, scales.measure(model, logs))
        assert {e.name for e in stack if e.loop} == expected
