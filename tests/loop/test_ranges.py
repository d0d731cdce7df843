"""Ranges that move: a truth beyond them is reached, physics stops them, and all of it is state."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from bayessim_mjx import registry
from bayessim_mjx.distributions import Distribution
from bayessim_mjx.inference import range_ends
from bayessim_mjx.inference.range_ends import Pile
from bayessim_mjx.loop import ranges
from bayessim_mjx.loop.sources import limits_of
from bayessim_mjx.parameters import Parameter, ParameterSpace
from bayessim_mjx.parameters.ranged import Ranged
from tests.loop.stub_source import FITTED, NOISE, SPACE, infer, made

MOVING = ["bayessim.range_ends=move", "bayessim.realIters=4", "bayessim.ensemble=1"]


def interval(q, i=0):
    """Central 99 % of a parameter."""
    return np.quantile(np.asarray(q.sample(jax.random.PRNGKey(0), 4000))[:, i], [0.005, 0.995])


@pytest.fixture(scope="module")
def beyond():
    """Three rounds of a truth at 4, with a range that ends at 1: it has to move twice."""
    parts, state = made(*MOVING, mass=4.0)
    rounds = []
    for _ in range(3):
        state, info = infer(parts, state)
        rounds.append((state, info))
    return parts, rounds


@pytest.mark.slow
def test_a_truth_beyond_the_range_is_reached_and_the_interval_covers_it(beyond):
    _, rounds = beyond
    ends = [(float(s.moving.space.low[0]), float(s.moving.space.high[0])) for s, _ in rounds]
    assert ends == [(-1.0, 3.0), (-1.0, 7.0), (-1.0, 7.0)]
    assert all(float(s.moving.space.high[1]) == 1.0 for s, _ in rounds)  # the other one stays
    for _, info in rounds[:2]:
        (told,) = info.moves
        assert told.name == "mass" and told.upper and told.sentence() in info.warnings
        assert "moves from" in told.sentence()
    q = rounds[2][1].posterior
    low, high = interval(q)
    assert not rounds[2][1].moves and low < 4.0 < high
    assert float(q.mean()[0]) == pytest.approx(np.asarray(rounds[2][0].real_features)[:6, 0].mean(), abs=0.1)
    assert float(q.sd()[0]) < 3 * NOISE / np.sqrt(6)


@pytest.mark.slow
@pytest.mark.ci
def test_the_next_domain_lies_over_the_wider_range_on_both_sides_of_the_wall(beyond):
    _, rounds = beyond
    state, info = rounds[0]
    assert float(info.posterior.space.high[0]) == 1.0 and float(state.domain.space.high[0]) == 3.0
    drawn = np.asarray(state.domain.sample(jax.random.PRNGKey(1), 2000))
    assert 0.1 < np.mean(drawn[:, 0] > 1.5) < 0.9 and drawn[:, 0].max() <= 3.0
    assert drawn[:, 1].std() == pytest.approx(2 / 12**0.5, rel=0.05)  # what is not identified keeps its prior


@pytest.mark.slow
@pytest.mark.ci
def test_simulations_kept_and_new_ones_are_draws_of_the_wider_prior(beyond):
    """U[-1, 1] and then, over [-1, 3], as many outside as there are inside."""
    _, rounds = beyond
    first, second = rounds[0][0].moving, rounds[1][0]
    assert int(first.rows) == FITTED  # all of the first round stay
    thetas = np.asarray(second.thetas)[: 2 * FITTED]
    counts = np.histogram(thetas[:, 0], bins=8, range=(-1, 3))[0]
    assert counts.sum() == 2 * FITTED and np.abs(counts - FITTED / 4).max() < 5 * (FITTED / 4) ** 0.5
    halves = thetas[:FITTED, 0], thetas[FITTED:, 0]  # any of them may be written over
    assert all(abs(np.mean(half < 1) - 0.5) < 0.05 for half in halves)


@pytest.mark.slow
@pytest.mark.ci
def test_another_move_compiles_nothing(beyond):
    """The ranges are arrays: the third round runs the programs of the second."""
    parts, rounds = beyond
    compiled: list[str] = []
    listener = lambda event, seconds, **_: compiled.append(event)  # noqa: E731
    jax.monitoring.register_event_duration_secs_listener(listener)
    try:
        infer(parts, rounds[1][0])
    finally:
        jax.monitoring.unregister_event_duration_listener(listener)
    assert "/jax/core/compile/backend_compile_duration" not in compiled


@pytest.mark.slow
@pytest.mark.ci
def test_a_run_killed_after_a_move_goes_on_bit_for_bit(beyond, tmp_path):
    from bayessim_mjx.runs import checkpoints

    parts, rounds = beyond
    fields = {f.name: getattr(rounds[0][0], f.name) for f in dataclasses.fields(rounds[0][0])}
    checkpoints.save(tmp_path / "1", {"state": fields}, step=1, meta={})
    blank = made(*MOVING, mass=4.0)[1]
    template = {f.name: getattr(blank, f.name) for f in dataclasses.fields(blank)}
    restored = checkpoints.restore(tmp_path / "1", {"state": template})[0]["state"]
    again, info = infer(parts, type(blank)(**restored))
    for x, y in zip(jax.tree.leaves(again), jax.tree.leaves(rounds[1][0]), strict=True):
        np.testing.assert_array_equal(np.asarray(x), np.asarray(y))
    assert info.moves == rounds[1][1].moves


@pytest.mark.slow
@pytest.mark.parametrize("proposal", ["apt", "truncated", "division"])
def test_posteriors_as_proposals_reach_it_too(proposal):
    parts, state = made(*MOVING, f"bayessim.proposal={proposal}", "bayessim.trainTrajs=1000", mass=2.5)
    for _ in range(3):  # after one of them its range holds it
        state, info = infer(parts, state)
    low, high = interval(info.posterior)
    assert low < 2.5 < high and high - low < 1.0
    assert float(np.asarray(info.posterior.space.high)[0]) >= 3.0


def test_reporting_leaves_the_state_as_it_was():
    _, state = made("bayessim.range_ends=report")
    assert state.moving is None and state.domain.space is SPACE
    assert not any("space" in jax.tree_util.keystr(path) for path, _ in jax.tree_util.tree_flatten_with_path(state)[0])


SPACES = Ranged(
    ParameterSpace(
        [
            Parameter("mass", 1.0, 0.5, 2.0, kind="body", attribute="mass"),
            Parameter("friction", 0.5, 0.0, 1.0, kind="geom", attribute="friction", operation="absolute"),
            Parameter("gain", 1.0, 0.1, 10.0, prior="loguniform"),
        ]
    )
)


def test_an_end_moves_by_the_width_of_its_range_and_no_further_than_physics():
    walls = [("mass", True), ("mass", False), ("friction", False), ("gain", True)]
    found = [Pile(name, upper, 0.5, 0.0) for name, upper in walls]
    space = SPACES
    found = [
        dataclasses.replace(p, limit=float((space.high if p.upper else space.low)[space.index(p.name)])) for p in found
    ]
    ends = np.array([0.0, 0.0, -np.inf]), np.array([3.0, np.inf, np.inf])
    after, told = range_ends.moved(space, found, *ends)
    np.testing.assert_allclose(after.high, [3.0, 1.0, 1000.0], rtol=1e-5)  # 3.5 is beyond 3; a factor of 100
    np.testing.assert_allclose(
        after.low, [0.125, 0.0, 0.1], rtol=1e-5
    )  # a mass stays above 0, friction is there already
    assert "nothing beyond it can be simulated" in told[2].sentence() and told[2].to_dict()["moved"] == 0.0
    # the prior over the wider range, where the range was before
    assert ranges.share(space, after) == pytest.approx((1.5 / 2.875) * 1.0 * 0.5, rel=1e-4)


@pytest.mark.parametrize("chart", ["plain", "probit"])
def test_a_distribution_over_wider_ranges_keeps_what_did_not_move(chart):
    after = Ranged(SPACES.start, [0.5, 0.0, 0.1], [3.5, 1.0, 10.0])
    u = jnp.asarray([[0.9, 0.3, 0.6], [0.95, 0.4, 0.5]])
    mean = u if chart == "plain" else jax.scipy.stats.norm.ppf(u)
    scale = jnp.tile(jnp.diag(jnp.asarray([0.1, 0.05, 0.08])) * (1 if chart == "plain" else 3), (2, 1, 1))
    q = Distribution.from_unit(SPACES, jnp.log(jnp.asarray([0.3, 0.7])), mean, scale, 0.05, chart)
    wide = q.over(after)
    np.testing.assert_allclose(wide.mean()[1:], q.mean()[1:], rtol=0.03)
    np.testing.assert_allclose(wide.sd()[1:], q.sd()[1:], rtol=0.08)
    low, high = interval(wide)
    assert low < 1.8 and high > 2.8  # the wall was at 2


def test_a_range_that_has_moved_is_saved_with_its_posterior(tmp_path):
    after = Ranged(SPACES.start, [0.05, 0.0, 0.1], [3.0, 1.0, 1000.0])
    q = Distribution.gaussian(after, [2.5, 0.5, 200.0], [0.1, 0.1, 20.0])
    again = Distribution.load(q.save(tmp_path / "q.npz"), SPACES.start)
    np.testing.assert_allclose(again.space.high, after.high)
    np.testing.assert_allclose(again.mean(), q.mean())
    assert (
        Distribution.load(Distribution.prior(SPACES.start).save(tmp_path / "p.npz"), SPACES.start).space is SPACES.start
    )


def test_limits_of_a_task_are_those_of_its_parameters():
    low, high = limits_of(registry.make("Pendulum"))
    np.testing.assert_array_equal(low, [0.0, 0.0])
    assert np.all(np.isinf(high))
