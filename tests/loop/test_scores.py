"""What the likelihood makes of prediction errors, and their scores, by hand: no simulation."""

from types import SimpleNamespace

import jax
import numpy as np
import pytest

from bayessim_mjx import config
from bayessim_mjx.distributions import Distribution
from bayessim_mjx.inference.product_calibration import stacked
from bayessim_mjx.loop import outer_loop, posterior
from bayessim_mjx.loop.likelihood import Likelihood
from bayessim_mjx.loop.likelihood_refinement import _spread
from bayessim_mjx.loop.state import Evidence
from bayessim_mjx.parameters import Parameter, ParameterSpace


@pytest.mark.parametrize(("total", "variance"), [(84.0, 1.0), (6.0, 1.0), (360.0, 3.0)])
def test_a_square_costs_half_of_itself_over_the_noises_variance(total: float, variance: float) -> None:
    """Of 120 errors; the variance that they show, but no less than what the sensors were told to have."""
    squares = np.array([total - 1, total + 1])[:, None, None]
    value = Likelihood.log_likelihood(SimpleNamespace(count=120.0, least=1.0), squares)
    assert (value[1] - value[0]) / 2 == pytest.approx(-0.5 / variance, rel=0.05)


def scores_of(scores: np.ndarray) -> np.ndarray:
    """Variance of the sum of scores [N, B] of one parameter, by `_spread`, over that which the likelihood promises."""
    z = np.tile([-1.0, 1.0], 50)[:, None]
    # a square's slope in z is -2 score; their mean is 1, as is the variance of z
    squares = 1.0 - 2.0 * z[:, :, None] * scores
    found, lower = _spread(
        z, squares, SimpleNamespace(count=float(scores.size), least=0.0, groups=np.zeros(len(scores)))
    )
    np.testing.assert_allclose(lower, [[1.0]])
    return found


def test_scores_of_neighbouring_stretches_add_up_on_both_sides() -> None:
    """Newey and West (1987) with lags up to 4 of 8 stretches: 1 + 2 (.8 * 7 + .6 * 6 + .4 * 5 + .2 * 4) / 8 = 4."""
    rng = np.random.default_rng(0)
    each = rng.normal(size=(4000, 1)) * np.ones(8)
    each = (each - each.mean()) / np.sqrt(np.sum((each - each.mean()) ** 2))
    np.testing.assert_allclose(scores_of(each), [[4.0]], rtol=0.01)
    alone = rng.normal(size=(4000, 8))
    alone = (alone - alone.mean()) / np.sqrt(np.sum((alone - alone.mean()) ** 2))
    np.testing.assert_allclose(scores_of(alone), [[1.0]], atol=0.05)


def test_schedules_of_randomisation_go_on_from_round_to_round() -> None:
    """A world has gone 7 iterations of 5 control steps in each of the three rounds before."""
    settings = config.load("Pendulum", overrides=["ppo.max_iterations=7", "ppo.num_steps=5"])
    parts = SimpleNamespace(env=None, config=settings, key=lambda *_: jax.random.PRNGKey(0))
    begun = outer_loop._new_policy(parts, 3, None, begin=lambda *_, clock: clock)
    assert begun == 3 * 7 * 5


def test_a_rounds_own_trajectories_are_judged_by_its_own_network(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where policies make the trajectories: the two of the round before keep theirs, the two of this one do not."""
    space = ParameterSpace([Parameter("mass", 1.0, 0.0, 2.0)])

    def four(middle: float) -> Distribution:
        return stacked([Distribution.from_unit(space, np.zeros(1), [[middle]], [[[0.05]]])] * 4)

    monkeypatch.setattr(posterior, "conditioned", lambda *_: four(0.6))
    monkeypatch.setattr(posterior, "kept", lambda factors, *_: factors)
    settings = config.load("Pendulum", overrides=["bayessim.realTrajs=2"]).bayessim
    parts = SimpleNamespace(settings=settings, source=SimpleNamespace(policy_dependent=True), feature_size=1)
    fit = SimpleNamespace(identified=None)
    state = SimpleNamespace(round=1, fit=fit, real_features=np.zeros((4, 1)), temperature=1.0)
    state.real_posteriors = four(0.3)
    found, warnings = posterior._factors(parts, state)
    assert not warnings
    np.testing.assert_allclose(found.means[:, 0, 0], [0.3, 0.3, 0.6, 0.6], rtol=1e-6)


def test_evidence_of_steps_adds_up_in_their_order() -> None:
    """A network that was fitted anew: the later fit counts, the time of both does."""
    first = Evidence({"fit": 1, "sets": 2}, {"a": 1.0}, ["one"], {"fit": 3.0}, {"standing": 4})
    second = Evidence({"fit": 5}, {"b": 2.0, "a": 3.0}, ["two"], {"fit": 6.0, "check": 1.0})
    fields, scores = {"fit": 5, "sets": 2}, {"a": 3.0, "b": 2.0}
    expected = Evidence(fields, scores, ["one", "two"], {"fit": 9.0, "check": 1.0}, {"standing": 4})
    assert first + second == expected and first + Evidence() == Evidence() + first == first
