"""`bayessim.refine` in rounds of the loop: the surrogate's truth, what is kept for a resume, what cannot be refined."""

import dataclasses
from types import SimpleNamespace

import jax
import numpy as np
import pytest

from bayessim_mjx import config, loop
from bayessim_mjx.distributions import Distribution
from bayessim_mjx.errors import UserError
from bayessim_mjx.inference.importance import Problem, Refined
from bayessim_mjx.loop import likelihood_refinement, outer_loop, round_inference
from bayessim_mjx.loop.likelihood import Likelihood
from bayessim_mjx.parameters import Parameter, ParameterSpace
from bayessim_mjx.registry import make
from bayessim_mjx.runs import checkpoints

SMALL = [
    "bayessim.trainTrajs=400", "bayessim.realTrajs=2", "bayessim.realIters=2", "bayessim.components=2",
    "bayessim.hiddenLayers=[16]", "bayessim.checkTrajs=0", "bayessim.ensemble=1", "bayessim.trainTrajLen=40",
    "bayessim.collectPolicy=policy_random", "real.noise=0.02",
]  # fmt: skip


def begun(*more: str) -> tuple[loop.Loop, loop.LoopState]:
    settings = config.load("Pendulum", overrides=[*SMALL, *more])
    parts = loop.make(settings, make("Pendulum", config=settings))
    return parts, loop.LoopState(round=jax.numpy.int32(0), train=None, **outer_loop.blank(parts))


def inferred(parts: loop.Loop, state: loop.LoopState) -> tuple[loop.LoopState, loop.RoundInfo]:
    info = loop.RoundInfo(
        round=int(state.round), rounds=2, domain=state.domain, posterior=None, truth=parts.source.truth,
        returns=np.zeros(1), lengths=np.zeros(1), real=None, predictive=None, fit={}, scores={}, seconds={},
        warnings=[],
    )  # fmt: skip
    state, found = round_inference.infer(parts, state, None)
    return dataclasses.replace(state, round=state.round + 1), info.with_(found)


class Killed(Exception):
    """The process ends here."""


@pytest.mark.slow
@pytest.mark.ci
def test_two_rounds_close_in_on_the_surrogate_also_if_killed_in_a_refinement_and_resumed(tmp_path, monkeypatch):
    parts, start = begun("bayessim.refine=likelihood")
    first, one = inferred(parts, start)
    checkpoints.save(tmp_path / "one", first, 1, {})
    second, two = inferred(parts, first)
    for info in (one, two):
        assert info.scores["refine/used"] == 1 and info.scores["refine/effective"] >= 200
        assert np.isfinite(info.refinement.refined.evidence)
        away = (np.asarray(info.posterior.mean()) - parts.source.truth) / np.asarray(info.posterior.sd())
        assert np.abs(away).max() < 3.5
    gains = [info.scores["gain_over_prior"] for info in (one, two)]
    assert min(gains) > 4 and gains[1] > gains[0] - 1.5
    assert np.all(np.asarray(second.motion["valid"]) == 1) and np.ptp(second.motion["qpos"], axis=1).min() > 0
    shapes = [jax.tree.map(lambda x: (x.shape, x.dtype), state) for state in (start, second)]
    assert shapes[0] == shapes[1]

    def restored() -> tuple[loop.Loop, loop.LoopState]:
        """As another process has them: nothing but the settings and the checkpoint."""
        parts, blank = begun("bayessim.refine=likelihood")
        return parts, checkpoints.restore(tmp_path / "one", blank)[0]

    squares, left = Likelihood.squares, iter(range(9))

    def until_killed(self, thetas):
        if next(left, None) is None:
            raise Killed
        return squares(self, thetas)

    with monkeypatch.context() as patch, pytest.raises(Killed):
        patch.setattr(Likelihood, "squares", until_killed)
        inferred(*restored())
    resumed, again = inferred(*restored())
    jax.tree.map(np.testing.assert_array_equal, jax.tree.leaves(resumed), jax.tree.leaves(second))
    assert again.refinement.to_dict() == two.refinement.to_dict()


def test_an_environment_without_our_physics_cannot_be_replayed():
    settings = config.load("Pendulum", overrides=[*SMALL, "bayessim.refine=likelihood"])
    env = make("Pendulum", config=settings)
    foreign = type("Foreign", (), {"space": env.space, "name": "brax:ant", "physics": None})()
    with pytest.raises(UserError, match="bayessim.refine=likelihood.*brax:ant.*allowed: auto, off"):
        loop.make(settings, foreign)


@pytest.mark.parametrize(
    ("task", "asked", "refines"),
    [("Pendulum", "auto", True), ("Pendulum", "off", False), ("Ant", "auto", False), ("Ant", "likelihood", True)],
)
def test_by_default_what_touches_nothing_is_refined(task, asked, refines):
    settings = config.load(task, overrides=[f"bayessim.refine={asked}"])
    assert loop.make(settings, make(task, config=settings)).refines is refines
    assert config.load(task).bayessim.refine == "auto"


def test_a_run_from_before_refinement_goes_on_without(tmp_path):
    from bayessim_mjx import runs

    run = runs.Run.create(tmp_path, "Pendulum", "", config.load("Pendulum"), ["test"])
    assert run.config.bayessim.refine == "auto"
    for path in (run.path / "params").glob("*.yaml"):
        kept = [line for line in path.read_text().splitlines() if "refine:" not in line]
        path.write_text("\n".join(kept) + "\n")
    assert run.config.bayessim.refine == "off"


def test_what_replays_tell_is_not_said_to_be_the_prior():
    """A network that identifies nothing: its posterior is the prior, but not the one that replays refined."""
    fit = {"identified": np.array([False, True]), "clipped": 0.0, "n_invalid": 0, "skipped": 0}
    before = np.ones(2, bool)
    (alone,) = round_inference.complaints(("mass", "length"), fit, before, by_replays=False, fresh=False)
    (refined,) = round_inference.complaints(("mass", "length"), fit, before, by_replays=True, fresh=False)
    assert alone == "not identified by these trajectories, kept at the prior: mass"
    assert "prior" not in refined
    assert "mass" in refined and "length" not in refined


def test_a_first_training_that_gained_nothing_is_told():
    """Hundreds of features learnt by heart looked like a network: none of its steps beat the linear start."""
    fit = {"identified": np.ones(1, bool), "clipped": 0.0, "n_invalid": 0, "skipped": 0}
    fit |= {"steps": 158, "n_train": 4500}
    known = np.ones(1, bool)

    def told(best: int, fresh: bool) -> list[str]:
        return round_inference.complaints(("mass",), fit | {"best": best}, known, by_replays=False, fresh=fresh)

    (text,) = told(-1, True)
    assert "linear posterior" in text and "158 steps" in text and "4500 trajectories" in text
    assert told(-1, False) == told(0, True) == []


def test_moves_that_do_not_reach_the_wider_posterior_do_not_throw_the_refined_one_away(monkeypatch):
    """Real logs of a servo: 1000 draws were the posterior's, those of the tempered one too few after 48 moves."""
    space = ParameterSpace([Parameter("mass", 1.0, 0.5, 2.0)])
    two = Distribution.from_unit(
        space, np.zeros(2), np.array([[0.3], [0.5]]), np.array([[[0.02]], [[0.02]]]), chart="plain"
    )
    draws = SimpleNamespace(u=np.zeros((8, 1)))
    found = Refined(two, two, draws, 400.0, 1000, np.ones(1), None)
    short = dataclasses.replace(found, reason="the draws are worth 90 independent ones", simulations=50_000)
    monkeypatch.setattr(likelihood_refinement.importance, "tempered", lambda *a, **k: short)
    monkeypatch.setattr(likelihood_refinement, "_spread", lambda *a: (np.array([[4.0]]), np.eye(1)))
    likelihood = SimpleNamespace(squares=lambda thetas: thetas)
    wide, factor = likelihood_refinement._adjusted(
        found, Problem(Distribution.prior(space), lambda t: t), likelihood, 0
    )
    assert factor == pytest.approx(2.0) and wide.reason is None and wide.simulations == 50_000
    assert np.asarray(wide.posterior.scales)[:, 0, 0] == pytest.approx(0.04)
    assert np.asarray(wide.posterior.means) == pytest.approx(np.asarray(two.means))
