"""A round never makes the posterior worse, by what simulations say; networks that left their range are fitted anew."""

import dataclasses
from types import SimpleNamespace

import jax.numpy as jnp
import numpy as np
import pytest

from bayessim_mjx.distributions import Distribution
from bayessim_mjx.loop import examination, round_inference
from bayessim_mjx.loop.state import Answer, Evidence
from tests.loop.stub_source import SPACE, infer, made


@dataclasses.dataclass
class State:
    standing: object
    standing_gain: object
    standing_round: object = None
    round: object = 0


def chosen(state: State, posterior: Distribution, gain: float) -> tuple[State, Answer, Evidence]:
    """The state after it, the answer and what was found for a posterior of one trajectory that gains so much."""
    settings = SimpleNamespace(temperature=None, realTrajs=1)
    parts = SimpleNamespace(settings=settings, sequential=False)
    learnt = SimpleNamespace(verdict=(SimpleNamespace(gain=gain), None))
    round_ = SimpleNamespace(loop=parts, state=state, learnt=learnt, known=1)
    answer, found = examination.keep_or_replace(round_, Answer(posterior))
    return dataclasses.replace(state, **found.kept), answer, found


def test_what_gains_more_on_simulated_sets_stands():
    first, second = Distribution.prior(SPACE, 2), Distribution.prior(SPACE, 2)
    state, used, found = chosen(State(first, jnp.float32(-np.inf)), second, 5.0)
    assert used.posterior is second and state.standing is second and float(state.standing_gain) == 5.0
    assert not found.warnings and used.source == "product"
    third = Distribution.prior(SPACE, 2)
    _, used, found = chosen(state, third, 4.0)
    assert used.posterior is second and used.source == "last round"
    assert not found.kept and found.scores == {"sets/stood": 1.0}
    assert "gains 4.0 nats" in found.warnings[0] and "5.0 nats" in found.warnings[0]
    _, used, found = chosen(state, third, -np.inf)
    assert used.posterior is second and "gains nothing" in found.warnings[0]
    after, used, _ = chosen(state, third, 5.5)
    assert used.posterior is third and float(after.standing_gain) == 5.5


def test_it_is_told_whose_posterior_stands():
    first = State(Distribution.prior(SPACE, 2), jnp.float32(-np.inf), standing_round=jnp.int32(0))
    state, *_ = chosen(first, first.standing, 5.0)
    assert int(state.standing_round) == 1 and examination.reused_posterior(dataclasses.replace(state, round=1)) == ""
    after, *_ = chosen(dataclasses.replace(state, round=1), first.standing, 4.0)
    text = examination.reused_posterior(dataclasses.replace(after, round=2))
    assert text == "the posterior in use is that of round 1: simulated trajectories promise less of round 2's"
    assert examination.reused_posterior(dataclasses.replace(first, round=1)) == ""  # nothing was judged


def test_without_a_judged_gain_nothing_stands_for_the_next_round():
    state = State(Distribution.prior(SPACE, 2), jnp.float32(-np.inf))
    _, used, found = chosen(state, state.standing, -np.inf)
    assert used.posterior is state.standing and found == Evidence()


def test_what_is_expected():
    report, counts = SimpleNamespace(gain=3.0), SimpleNamespace(at=lambda n: SimpleNamespace(gain=10.0 * n))
    assert examination.expected(report, None, 1) == 3.0 and examination.expected(report, counts, 4) == 40.0
    assert examination.expected(report, None, 2) == -np.inf  # hardly any set was a density
    assert examination.expected(SimpleNamespace(gain=np.nan), None, 1) == -np.inf


@pytest.mark.parametrize(("pairs", "lost"), [(100, False), (95, False), (94, True), (None, True)])
def test_a_network_is_lost_where_its_posteriors_are_no_densities(pairs, lost):
    """Simulations that diverged are nobody's fault."""
    x = jnp.zeros((120, 3)).at[100:].set(jnp.nan)
    assert round_inference.lost(None if pairs is None else SimpleNamespace(densities=pairs), x) == lost


@pytest.mark.slow
def test_a_lost_network_is_fitted_anew(monkeypatch):
    parts, start = made("bayessim.ftune=True", "bayessim.checkTrajs=100")
    state, _ = infer(parts, start)
    assert float(state.standing_gain) > 1.0  # of the first round, on sets of two
    calls: list[bool] = []
    train = round_inference.train

    def watched(*args, **more):
        calls.append(more.get("anew", False))
        return train(*args, **more)

    monkeypatch.setattr(round_inference, "train", watched)
    infer(parts, state)
    monkeypatch.setattr(round_inference, "lost", lambda report, x: len(calls) == 2)
    after, info = infer(parts, state)
    assert calls == [False, False, True]
    assert any("fitted anew" in text for text in info.warnings)
    x = np.asarray(after.real_features)[:4, 0]
    assert float(info.posterior.mean()[0]) == pytest.approx(x.mean(), abs=0.1)
