"""Sequential rounds against analytic posteriors."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from bayessim_mjx.distributions import Distribution
from bayessim_mjx.inference import InferenceSettings, init, mdn
from bayessim_mjx.inference.rounds import draw_truncated, proposal_of, sequential, stack
from bayessim_mjx.parameters import Parameter, ParameterSpace

NORMAL = ParameterSpace([Parameter(n, 0.0, -3.0, 3.0, prior="gaussian", mean=0.0, sd=0.5) for n in ("a", "b")])
FLAT = ParameterSpace([Parameter("a", 0.0, -1.0, 1.0), Parameter("b", 0.0, -1.0, 1.0)])
NOISE = 0.1
SETTINGS = InferenceSettings(
    components=2, hiddenLayers=(16,), min_steps=300, max_steps=300, coordinates="probit", ensemble=1
)


def key(seed: int = 0) -> jax.Array:
    return jax.random.PRNGKey(seed)


def simulate(key: jax.Array, thetas: jax.Array) -> jax.Array:
    return thetas + NOISE * jax.random.normal(key, thetas.shape)


@pytest.mark.slow
@pytest.mark.parametrize(("method", "coordinates", "ftune"), [("apt", "probit", True)])
def test_every_method_finds_the_analytic_posterior(method, coordinates, ftune):
    """The naive fit to the second round would have the sd of the product of posterior and proposal: 0.71 of it."""
    space = NORMAL if coordinates == "probit" else FLAT
    settings = dataclasses.replace(SETTINGS, coordinates=coordinates)
    x = jnp.asarray([[0.3, -0.2]])
    rounds = sequential(key(), settings, space, simulate, x, (1000, 1500), method, ftune)
    prior = 4.0 if coordinates == "probit" else 0.0
    precision = prior + 1 / NOISE**2
    q = rounds.posterior
    np.testing.assert_allclose(q.sd(), precision**-0.5, rtol=0.15)
    np.testing.assert_allclose((q.mean() - x[0] / NOISE**2 / precision) * precision**0.5, 0.0, atol=0.3)
    assert len(rounds.infos) == 2 and rounds.lost < 0.2
    later = np.asarray(rounds.thetas)[np.asarray(rounds.origin) == 1]
    assert later.std(0).max() < 0.3  # simulated where the posterior is


def test_the_tilt_is_the_integral_over_the_cube():
    """log of the integral of q(theta) proposal(theta) / prior(theta), by quadrature over the prior's points."""
    rng = np.random.default_rng(0)
    for coordinates in ("probit", "plain"):
        settings = dataclasses.replace(SETTINGS, coordinates=coordinates, defensive=0.0)
        state = init(key(), settings, FLAT, 2)
        params = jax.tree.map(lambda v: v[0], state.params)
        bias = params["layers"][-1]["b"].at[6:10].set(2.0)  # sd 0.14 of the prior's: inside the box
        params["layers"][-1]["b"] = bias.at[2:6].multiply(0.4)
        x = jnp.asarray(rng.normal(size=(1, 2)) * 0.1, jnp.float32)
        centre, scale = (0.0, 0.4) if coordinates == "probit" else (0.5, 0.1)
        means = np.float32(centre + 0.3 * scale * rng.normal(size=(2, 2)))
        proposal = Distribution.from_unit(
            FLAT, [0.2, -0.1], means, scale * np.eye(2) * np.ones((2, 1, 1)), 0.1, coordinates
        )

        @jax.jit
        def both(params, x, proposals, settings=settings):
            tilt = mdn.log_tilt(mdn.forward(params, x, 2, settings), proposals, settings)
            return tilt, mdn.mixture(params, x, 2, settings)

        got, mixture = both(params, x, stack([proposal]))
        logits, m, s = (v[0] for v in mixture)
        q = Distribution.from_unit(FLAT, logits, m, s, 0.0, coordinates)
        axis = -1 + 2 * (np.arange(400) + 0.5) / 400
        points = np.stack(np.meshgrid(axis, axis, indexing="ij"), -1).reshape(-1, 2).astype(np.float32)
        exact = np.log(np.mean(np.exp(np.asarray(q.log_gain(points) + proposal.log_gain(points), np.float64))))
        assert float(got[0]) == pytest.approx(exact, abs=0.01)


def test_the_prior_as_proposal_needs_no_correction():
    state = init(key(), SETTINGS, NORMAL, 2)
    params = jax.tree.map(lambda v: v[0], state.params)
    params.pop("member")  # a number of a network, no weight
    prior = stack([Distribution.prior(NORMAL, 3, "probit")])

    def tilt(params):
        return mdn.log_tilt(mdn.forward(params, jnp.ones((1, 2)), 2, SETTINGS), prior, SETTINGS)[0]

    value, gradient = jax.jit(jax.value_and_grad(tilt))(params)
    assert float(value) == pytest.approx(0.0, abs=1e-6)
    assert all(float(jnp.abs(leaf).max()) == 0.0 for leaf in jax.tree.leaves(gradient))


def test_truncated_draws_are_uniform_on_the_region():
    q = Distribution.gaussian(FLAT, [0.2, 0.0], 0.1)
    draws, volume = draw_truncated(key(), q, 4000, mass=0.05)
    radius2 = np.sum((np.asarray(draws) - [0.2, 0.0]) ** 2, axis=1) / 0.1**2
    edge = -2 * np.log(0.05)  # 95 % of a Gaussian in two dimensions
    assert radius2.max() == pytest.approx(edge, rel=0.1)
    assert np.mean(radius2) == pytest.approx(edge / 2, rel=0.1)  # uniform on a disc
    assert volume == pytest.approx(np.pi * edge * 0.01 / 4, rel=0.1)


def test_proposals_of_all_methods():
    q = Distribution.from_unit(FLAT, np.zeros(3), [[0.3, 0.3], [0.5, 0.5], [0.7, 0.6]], [0.1 * np.eye(2)] * 3, 0.01)
    one = proposal_of(q, "division")
    assert one.components == 1 and float(one.prior_weight) == 0.0
    np.testing.assert_allclose(one.mean(), q.mean(), atol=0.02)
    assert float(proposal_of(q, "apt").prior_weight) == pytest.approx(0.1)
    both = stack([q, one])
    assert both.logits.shape == (2, 8 if both.components == 8 else 3)
    np.testing.assert_allclose(both.split()[1].log_gain(jnp.zeros(2)), one.log_gain(jnp.zeros(2)), atol=1e-3)
    with pytest.raises(ValueError, match="apt, truncated, division"):
        proposal_of(q, "snpe")
    with pytest.raises(ValueError, match="not logit"):
        sequential(key(), dataclasses.replace(SETTINGS, coordinates="logit"), FLAT, simulate, jnp.zeros((1, 2)), (10,))
