"""Inference within the loop, on a source that is no simulator: every chart, ensembles, corrections, temperature."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from bayessim_mjx.loop import examination
from bayessim_mjx.loop.state import Situation
from tests.loop.stub_source import FITTED, NOISE, NORMAL, SPACE, infer, made


def assert_same_structure(a, b):
    assert jax.tree.structure(a) == jax.tree.structure(b)
    assert [(x.shape, x.dtype) for x in jax.tree.leaves(a)] == [(x.shape, x.dtype) for x in jax.tree.leaves(b)]


CASES = [
    pytest.param("probit", "apt", "2", id="probit-apt-ensemble", marks=[pytest.mark.slow, pytest.mark.ci]),
    pytest.param("plain", "truncated", "1", id="plain-truncated", marks=pytest.mark.slow),
    pytest.param("logit", "prior", "2", id="logit-ensemble", marks=pytest.mark.slow),
    pytest.param("truncated", "prior", "1", id="truncated", marks=pytest.mark.slow),
    pytest.param("plain", "division", "1", id="plain-division", marks=pytest.mark.slow),
    pytest.param("logit", "truncated", "1", id="logit-truncated", marks=pytest.mark.slow),
    pytest.param("auto", "apt", "2", id="auto-apt-ensemble", marks=pytest.mark.slow),
]


@pytest.mark.parametrize(("coordinates", "proposal", "ensemble"), CASES)
def test_two_rounds_give_the_analytic_posterior_and_a_restorable_state(coordinates, proposal, ensemble):
    """Exact for the mass: the mean of the measured features, sd 0.1 / sqrt(n); the unseen parameter keeps its prior."""
    parts, start = made(
        f"bayessim.coordinates={coordinates}", f"bayessim.proposal={proposal}", f"bayessim.ensemble={ensemble}",
        space=NORMAL if coordinates == "auto" else SPACE,
    )  # fmt: skip
    state, first = infer(parts, start)
    assert_same_structure(state, start)  # what a checkpoint is restored into
    again, second = infer(parts, state)
    assert_same_structure(again, start)
    for info, n in ((first, 2), (second, 4)):
        q = info.posterior
        assert q.components == 2 and q.chart == parts.chart
        x = np.asarray(again.real_features)[:n, 0]
        assert float(q.sd()[0]) == pytest.approx(NOISE / np.sqrt(n), rel=0.35)
        assert float(q.mean()[0]) == pytest.approx(x.mean(), abs=NOISE / np.sqrt(n))
        assert abs(float(q.contraction()[1])) < 0.03
    if proposal != "prior":  # the second round was simulated where the first posterior was
        rows = np.asarray(again.thetas)[FITTED : 2 * FITTED] if parts.capacity else None
        assert rows is None or rows[:, 0].std() < 0.35
        assert float(again.proposal.contraction()[0]) > 0.5 > float(start.proposal.contraction()[0])


@pytest.mark.slow
@pytest.mark.ci
def test_coordinates_of_the_loop_are_probit_where_every_prior_is_gaussian():
    parts, state = made(space=NORMAL)
    assert parts.settings.coordinates == "auto"
    assert parts.chart == state.domain.chart == state.real_posteriors.chart == state.fit.settings.chart == "probit"


TESTED = ["bayessim.checkTrajs=200", "bayessim.priorShare=0.0"]


@pytest.fixture(scope="module")
def usual():
    return infer(*made(*TESTED))


@pytest.mark.slow
def test_nothing_is_said_where_nothing_is_wrong_but_what_is_not_identified(usual):
    state, info = usual
    assert info.checks.prior_share == 0.0 and float(state.temperature) == 1.0
    assert all("unseen" in text for text in info.warnings) and info.warnings
    assert not info.checks.piles and not info.checks.misfit.flagged
    np.testing.assert_array_equal(state.domain.prior_weight, info.posterior.prior_weight)


@pytest.mark.slow
def test_reality_unlike_simulation_is_told_by_name_and_part_of_the_randomisation_is_the_prior():
    state, info = infer(*made(*TESTED, "bayessim.distrust=0.4", offset=8.0))
    (told,) = [text for text in info.warnings if "unlike anything simulated" in text]
    assert "most in push at step 0" in told and "of the randomisation is drawn from the prior" in told
    share = info.checks.prior_share
    assert 0.2 < share <= 0.4 and share == pytest.approx(0.4 * (1 - info.checks.misfit.joint / 0.05), abs=1e-6)
    at = jnp.asarray([[0.9, 0.9], [0.3, 0.0]])
    mixed = share + (1 - share) * np.exp(np.asarray(info.posterior.log_gain(at)))
    np.testing.assert_allclose(np.exp(np.asarray(state.domain.log_gain(at))), mixed, rtol=1e-3)


@pytest.mark.slow
def test_a_truth_beyond_the_range_is_told_with_parameter_and_side():
    _, info = infer(*made(*TESTED, mass=1.15))
    (told,) = [text for text in info.warnings if "end of its range" in text]
    assert told.startswith("mass:") and "upper end" in told and "raise its limit 1" in told


@pytest.mark.slow
def test_an_over_confident_network_gets_a_temperature_which_is_told_kept_and_used(usual):
    parts, start = made(*TESTED, quiet=0.5)
    state, info = infer(parts, start)
    factor = float(state.temperature)
    assert "standard deviations times" in info.checks.sentence()
    assert info.checks.calibration.before == "over-confident"
    assert float(info.posterior.sd()[0]) == pytest.approx(NOISE / np.sqrt(2), rel=0.3)
    # given, it is applied as it is, and what is tested is the posterior that is used
    fixed, given = infer(*made(*TESTED, "bayessim.temperature=1", quiet=0.5))
    assert float(fixed.temperature) == 1.0 and given.checks.calibration.verdict == "over-confident"
    # a network that knew half the noise; what its own held-out rows had it widened by is not needed again
    network = float(given.posterior.sd()[0]) * np.sqrt(2)
    assert network == pytest.approx(0.5 * NOISE, rel=0.25) and factor == pytest.approx(NOISE / network, rel=0.2)
    assert float(info.posterior.sd()[0] / given.posterior.sd()[0]) == pytest.approx(factor, rel=0.1)


@pytest.mark.slow
def test_products_of_several_trajectories_are_judged_and_widened():
    """A network's errors are the same for all trajectories at one theta; sets of them show it."""
    parts, state = made("bayessim.checkTrajs=40", "bayessim.realTrajs=4", "bayessim.ensemble=1")
    state, info = infer(parts, state)
    assert [c.trajectories for c in info.sets.counts] == [1, 2, 4]
    last = info.sets.at(4)
    assert info.checks.sets is info.sets and not any("as used" in text for text in info.warnings)
    assert info.scores["sets/widening"] == info.sets.widening(4) >= last.widening >= 1
    for level in (0.5, 0.8, 0.95):
        assert info.scores[f"sets/coverage_{100 * level:.0f}"] == pytest.approx(level, abs=0.2)
    assert last.gain >= last.plain - 0.1 and info.sets.near
    assert float(state.domain.sd()[0]) > 0.9 * NOISE / 4**0.5  # never surer than the exact posterior
    now = Situation(parts, dataclasses.replace(state, round=state.round - 1), None)
    again = examination.rejudge(now, jax.random.PRNGKey(1), 2)  # as the command `calibrate` asks for it
    # as the round used it
    assert [c.widening for c in again.counts] == [info.sets.widening(c.trajectories) for c in info.sets.counts]
    assert again.near[0].widening == info.sets.widening(4) and (again.move is None) == (info.sets.move is None)
    assert len(again.at(4).levels) == len(again.near[0].levels) == 128 and not again.off
    assert not np.array_equal(again.at(4).levels[:64], last.levels)  # on sets that the round did not see
    told = again.to_dict()
    assert told["sets"] == 128 and told["carried"] == again.saturates_at and len(told["near"]) == 1


def test_a_single_trajectory_needs_no_set():
    parts, state = made("bayessim.checkTrajs=40", "bayessim.realTrajs=1")
    assert examination.judge(Situation(parts, state, None)) is None
