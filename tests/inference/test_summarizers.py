"""Summaries computed by hand."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from bayessim_mjx.config.names import SUMMARIES
from bayessim_mjx.config.settings import BayesSimConfig
from bayessim_mjx.errors import UserError
from bayessim_mjx.inference import summarizers
from bayessim_mjx.inference.summarizers import stream

STATES = jnp.asarray([[0.0, 1.0], [1.0, 1.0], [3.0, 0.0], [6.0, 0.0]])  # T = 3, S = 2
ACTIONS = jnp.asarray([[1.0], [2.0], [-1.0]])


pytestmark = pytest.mark.usefixtures("strict")


def test_start_is_the_whole_trajectory_time_major():
    x = summarizers.summary_start(STATES, ACTIONS)
    np.testing.assert_array_equal(x, [0, 1, 1, 1, 1, 2, 3, 0, -1, 6, 0])
    np.testing.assert_array_equal(summarizers.summary_start(STATES, ACTIONS, steps=1), [0, 1, 1, 1, 1])


def test_corrdiff_is_the_inner_product_over_time_with_per_dimension_moments():
    x = summarizers.summary_corrdiff(STATES, ACTIONS)
    # tau = (1, 0), (2, -1), (3, 0):  <tau_0, a> = 1 + 4 - 3,  <tau_1, a> = -2
    np.testing.assert_allclose(x, [2.0, -2.0, 2.0, -1 / 3, 2 / 3, 2 / 9], rtol=1e-6)
    lagged = summarizers.summary_corrdiff(STATES, ACTIONS, lags=1)
    np.testing.assert_allclose(lagged[2:4], [2 * 1 + 3 * 2, -1 * 1], rtol=1e-6)


def test_corr_uses_the_states_before_the_actions():
    np.testing.assert_allclose(summarizers.summary_corr(STATES, ACTIONS)[:2], [0 + 2 - 3, 1 + 2 + 0])


def test_waypoints_span_the_trajectory():
    x = np.asarray(summarizers.summary_waypts(STATES, ACTIONS, waypoints=2)).reshape(2, 3)
    np.testing.assert_array_equal(x, [[0, 1, 1], [6, 0, -1]])


@pytest.mark.parametrize("name", SUMMARIES.library)
def test_every_step_of_a_long_trajectory_counts_and_maps(name):
    rng = np.random.default_rng(0)
    states = jnp.asarray(rng.normal(size=(5, 41, 3)), jnp.float32)
    actions = jnp.asarray(rng.normal(size=(5, 40, 2)), jnp.float32)
    summarize = summarizers.get(name)
    x = jax.jit(jax.vmap(summarize))(states, actions)
    assert x.shape == (5, summarizers.size(summarize, 40, 3, 2)) and np.all(np.isfinite(x))
    late = jax.vmap(summarize)(states.at[:, 40].add(1.0), actions)
    assert not np.allclose(x, late)  # the very last state is seen


def random_trajectory(steps: int = 12) -> tuple[jax.Array, jax.Array]:
    rng = np.random.default_rng(1)
    return tuple(jnp.asarray(rng.normal(size=shape), jnp.float32) for shape in ((steps + 1, 2), (steps, 1)))


def test_correlations_of_a_sine_and_a_cosine_are_known():
    """Over whole periods <sin, cos> = 0, <cos, cos> = T/2, and a shift by a quarter turns one into the other."""
    t = np.arange(41)
    states = jnp.asarray(np.stack([np.sin(t * np.pi / 20), np.cos(t * np.pi / 20)], axis=1), jnp.float32)
    actions = jnp.asarray(np.cos(t[:40, None] * np.pi / 20), jnp.float32)
    x = summarizers.summary_corr(states, actions, lags=10)
    np.testing.assert_allclose(x[:2], [0.0, 20.0], atol=1e-4)
    # lag 10 over t = 10..39: sin(t) against cos(t - 10) = sin(t)
    assert float(x[2 * 10]) == pytest.approx(np.sum(np.sin(t[10:40] * np.pi / 20) ** 2), abs=1e-4)
    np.testing.assert_allclose(x[-2:], [0.5 * 40 / 41, 20.5 / 41 + 0.5 / 41 - 1 / 41**2], atol=1e-3)


def test_signature_by_hand():
    """Level 1: where the path ends. Level 2: int a_j ds_i with the action held is corrdiff's product."""
    states, actions = random_trajectory()
    x = np.asarray(summarizers.summary_signatory(states, actions, depth=2))
    end = np.asarray([1.0, *states[-1], actions[-1, 0]])
    np.testing.assert_allclose(x[:4], end, atol=1e-5)
    second = x[4:].reshape(4, 4) / 2  # levels come times k!
    products = np.asarray(summarizers.summary_corrdiff(states, actions))[:2]
    np.testing.assert_allclose(second[3, 1:3], products, atol=1e-5)
    # int s dt of a path that moves in straight lines: the trapezoidal rule
    np.testing.assert_allclose(second[1:3, 0], np.trapezoid(np.asarray(states), dx=1 / 12, axis=0), atol=1e-5)
    np.testing.assert_allclose(second + second.T, np.outer(end, end), atol=1e-5)  # shuffle identity


def test_the_log_signature_holds_the_same_information_in_fewer_numbers():
    states, actions = random_trajectory()
    whole = np.asarray(summarizers.summary_signatory(states, actions, depth=2))
    short = np.asarray(summarizers.summary_logsignature(states, actions, depth=2))
    assert (whole.size, short.size) == (4 + 16, 4 + 6)
    area = (whole[4:].reshape(4, 4) - whole[4:].reshape(4, 4).T) / 2
    np.testing.assert_allclose(short, [*whole[:4], *area[np.triu_indices(4, 1)]], atol=1e-5)


@pytest.mark.parametrize("name", ["signatory_3", "logsignature_3"])
def test_the_parallel_form_is_the_same(name):
    trajectory = random_trajectory()
    a, b = (jax.jit(summarizers.get(name, parallel=form))(*trajectory) for form in (False, True))
    np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("name", SUMMARIES.library)
def test_what_comes_after_the_end_does_not_count(name):
    states, actions = random_trajectory()
    valid = jnp.asarray([1.0] * 7 + [0.0] * 5)
    summarize = jax.jit(summarizers.get(name))
    x = summarize(states, actions, valid)
    garbage = summarize(states.at[8:].set(1e6), actions.at[7:].set(-3.0), valid)
    np.testing.assert_array_equal(x, garbage)
    assert not np.array_equal(x, summarize(states.at[7].add(1.0), actions, valid))  # the state at the end does
    sticky = states.at[8:].set(states[7]), actions.at[7:].set(actions[6])  # as `rollout` leaves it
    np.testing.assert_allclose(x[:-12], summarize(*sticky)[:-12], atol=1e-5)
    np.testing.assert_array_equal(x, summarize(*sticky, valid))


@pytest.mark.parametrize("name", ["corr", "corrdiff_2", "corr_3", "signatory", "logsignature_2"])
@pytest.mark.parametrize("ran", [12, 5])
def test_streams_give_the_same_without_the_trajectory(name, ran):
    states, actions = random_trajectory()
    states = states + 20.0  # the variance must not drown in the mean
    valid = (jnp.arange(12) < ran).astype(jnp.float32)
    form = stream(name, 12, 2, 1)

    @jax.jit
    def run(states, actions, valid):
        rows = actions, states[1:], valid
        return form.read(jax.lax.scan(lambda c, row: (form.step(c, *row), None), form.init(states[0]), rows)[0])

    np.testing.assert_allclose(run(states, actions, valid), summarizers.get(name)(states, actions, valid), 2e-4, 2e-4)


def test_summaries_that_are_rows_of_the_trajectory_have_no_stream():
    with pytest.raises(UserError, match="summary_start has no streaming form; corr"):
        stream("start", 12, 2, 1)
    with pytest.raises(UserError, match="lags = 12.*allows 0 to 11"):
        stream("corr_12", 12, 2, 1)


SIZES = {  # T = 20, S = 4, A = 2, as documented
    "start": 20 * 6 + 4, "start_5": 5 * 6 + 4, "waypts": 10 * 6, "waypts_21": 21 * 6, "corr": 8 + 8,
    "corrdiff_3": 4 * 8 + 8, "signatory": 7 + 49 + 343, "signatory_2": 7 + 49, "logsignature": 7 + 21 + 112,
    "learned": (21 + 20) * 4 + 20 * 2 + 20,
}  # fmt: skip


@pytest.mark.parametrize("name", SIZES)
def test_sizes_are_the_documented_ones(name):
    assert summarizers.size(summarizers.get(name), 20, 4, 2) == SIZES[name]


def test_too_short_and_too_large_is_refused_with_what_is_allowed():
    refused = {
        ("start_30", 20, 4, 2): "steps = 30: a trajectory of 20 steps allows 1 to 20",
        ("waypts_22", 20, 4, 2): "waypoints = 22: 20 steps have 1 to 21 states",
        ("corr_20", 20, 4, 2): "lags = 20.*allows 0 to 19",
        ("start", 0, 4, 2): "T >= 1",
        ("start", 300, 60, 8): "summary_start has 20,460 features; at most 16,384",
        ("signatory_3", 20, 60, 8): "depth 3 over 69 channels has 333,339 features.*take summary_signatory_2, summary",
        ("signatory", 20, 211, 20): "depth 2 over 232 channels has 54,056 .*take corrdiff",
        ("signatory", 20, 130, 8): "has 19,460 features.*take summary_logsignature, corrdiff",
        ("signatory_0", 20, 4, 2): "depth = 0",
    }
    for (name, *shape), message in refused.items():
        with pytest.raises(UserError, match=message):
            summarizers.size(summarizers.get(name), *shape)
    assert summarizers.size(summarizers.get("logsignature"), 20, 130, 8) == 139 + 139 * 138 // 2
    assert summarizers.size(summarizers.get("signatory"), 20, 60, 8) == 69 + 69**2  # BayesSimIG's depth for Ant
    with pytest.raises(UserError, match=r"valid has shape \(3,\): expected \(12,\)"):
        summarizers.summary_corr(*random_trajectory(), jnp.ones(3))


def test_the_configuration_takes_every_summary():
    for name in (*SUMMARIES.library, "corrdiff_3", "signatory_2", "waypts_5"):
        assert summarizers.get(BayesSimConfig(summarizerFxn=name).summarizerFxn) is not None
    assert BayesSimConfig(summarizerFxn="corrdiff_3").summarizerFxn == "summary_corrdiff_3"
    with pytest.raises(UserError, match=r"bayessim\.summarizerFxn = 'summary_signatori_3' \(did you mean summary_sig"):
        BayesSimConfig(summarizerFxn="signatori_3")
    with pytest.raises(UserError, match="summary_learned takes no number"):
        BayesSimConfig(summarizerFxn="learned_3")


def test_names_are_checked():
    assert summarizers.get("start") is summarizers.summary_start
    assert summarizers.get("summary_corrdiff", lags=2)(STATES, ACTIONS).shape == (3 * 2 + 4,)
    with pytest.raises(ValueError, match="did you mean summary_corrdiff.*allowed are summary_start"):
        summarizers.get("summary_cordiff")
    with pytest.raises(ValueError, match="lags = 3"):
        summarizers.summary_corrdiff(STATES, ACTIONS, lags=3)
    with pytest.raises(ValueError, match=r"states \[T\+1, S\]"):
        summarizers.summary_start(STATES[:-1], ACTIONS)
