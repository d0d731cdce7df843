"""The part of noise that lasts for an episode: each kind has draws of its own."""

import jax
import jax.numpy as jnp
import numpy as np

from bayessim_mjx.parameters import ParameterSpace
from bayessim_mjx.physics import nuisance

WORLDS = 2000
STANDARD = {"distribution": "gaussian", "operation": "additive"}


def test_lasting_noise_of_a_world_is_drawn_apart_for_observations_actions_and_gravity() -> None:
    """Of one size each, they are uncorrelated: 2000 worlds tell 0.1."""
    alike = {**STANDARD, "range": [0.0, 0.0], "range_correlated": [0.0, 1.0]}
    gravity = {**STANDARD, "range": [0.0, 1.0]}
    found = nuisance.read(
        {"observations": alike, "actions": alike, "sim_params": {"gravity": gravity}}, ParameterSpace()
    )
    assert found is not None

    def one(key: jax.Array) -> jax.Array:
        drawn = found.seen(found.begin(key, None, 3), 3)
        return jnp.stack([drawn.observation, drawn.action, found.gravity_of(drawn, jnp.zeros(3))])

    drawn = np.asarray(jax.vmap(one)(jax.random.split(jax.random.PRNGKey(0), WORLDS))).reshape(WORLDS, 9)
    np.testing.assert_allclose(np.corrcoef(drawn.T), np.eye(9), atol=0.1)
