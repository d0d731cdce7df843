"""The monitor of a run without a run: which physics its videos show, when it films, what a resumed one takes back."""

import io
import types

import numpy as np
import pytest

from bayessim_mjx import config, loop
from bayessim_mjx.inference.product_calibration import Count, Sets
from bayessim_mjx.monitor import session, video
from bayessim_mjx.monitor.console import Console
from bayessim_mjx.monitor.film import Motion
from bayessim_mjx.parameters import Parameter, ParameterSpace

SPACE = ParameterSpace([Parameter("mass", 1.0, 0.5, 2.0)])
ENV = types.SimpleNamespace(space=SPACE, mj_model=None, dt=0.1)
SETTINGS = ["ppo.num_steps=4", "ppo.max_iterations=4", "monitor.video_interval=8", "monitor.posterior_plots=False"]
Posterior = types.SimpleNamespace


def posterior(mean):
    numbers = types.SimpleNamespace(width=np.ones(1))
    own = dict(space=SPACE, describe=dict, prior_weight=0.0, estimates=lambda: numbers)
    return Posterior(mean=lambda: np.array([mean]), **own)


def state(round_=0, iteration=0, domain=None):
    return types.SimpleNamespace(round=round_, train=types.SimpleNamespace(iteration=iteration), domain=domain)


def info(round_, truth=None, mean=None):
    found = None if mean is None else posterior(mean)
    numbers = dict(returns=np.zeros(2), lengths=np.ones(2), scores={}, seconds={}, warnings=[], fit={})
    return loop.RoundInfo(
        round=round_, rounds=2, domain=None, posterior=found, truth=truth, real=None, predictive=None, **numbers
    )


@pytest.fixture
def filmed(monkeypatch):
    """The theta of every video that is made; the model it is drawn with has to be that of theta."""
    monkeypatch.setattr(video, "model_at", lambda env, theta: float(theta[0]))

    def record(model, qpos, *_, **__):
        assert (model == qpos).all(), "another model"

    monkeypatch.setattr(video, "record", record)
    monkeypatch.setattr(session, "policy_of", lambda train: None)
    return []


def watch(path, filmed, start=None, resumed_at=None, truth=None):
    def film(policy, length, theta):
        filmed.append(float(theta[0]))
        return Motion(np.full((1, 1), filmed[-1]), np.zeros(1), 0.1)

    settings = config.load("Pendulum", overrides=SETTINGS)
    return session.Session(path, settings, ENV, Console(file=io.StringIO()), film, start, resumed_at, truth)


def test_videos_show_the_truth_where_it_is_known(tmp_path, filmed):
    s = watch(tmp_path, filmed, truth=np.array([1.5]))
    s.training(0, {}, state(iteration=2))
    s.round(info(0, truth=np.array([1.5]), mean=0.75), None)
    s.close()
    assert filmed == [1.5, 1.5]


def test_a_round_says_what_simulated_sets_asked_of_the_product(tmp_path, filmed):
    """How wide it had to be made, and how many trajectories the network can carry."""
    s, said = watch(tmp_path, filmed), info(0, mean=0.75)
    s.console = Console(file=(shown := io.StringIO()))
    few, none = (Count(n, w, 1.0, 0.1, 0.5, np.full(64, 0.5)) for n, w in ((1, 1.0), (2, 1.4)))
    said.sets = Sets((few, none))
    s.round(said, None)
    s.close()
    text = " ".join(shown.getvalue().split())
    assert "product of the network's posteriors: with 2 trajectories standard deviations are widened 1.40 times" in text
    assert "only 1 of 2 trajectories sharpen the posterior" in text


@pytest.mark.parametrize("used", [True, False])
def test_a_round_says_which_posterior_is_in_use(tmp_path, filmed, used):
    """Replays replace the product, unless they are refused: the console has a line for each."""
    s, said = watch(tmp_path, filmed), info(0, mean=0.75)
    s.console = Console(file=(shown := io.StringIO()))
    said.sets = Sets((Count(1, 1.0, 1.0, 0.1, 0.5, np.full(64, 0.5)),))
    said.refinement = types.SimpleNamespace(used=used, sentence=lambda: "as it is", to_dict=dict)
    s.round(said, None)
    s.close()
    assert (
        "product of the network's posteriors, a start for the replays: " in " ".join(shown.getvalue().split())
    ) == used


def test_videos_under_logs_show_the_newest_posterior(tmp_path, filmed):
    s = watch(tmp_path, filmed)
    s.training(0, {}, state(iteration=2))
    s.round(info(0, mean=0.75), None)
    s.training(1, {}, state(1, 6))
    s.round(info(1), None)
    s.close()
    assert filmed == [1.0, 0.75, 0.75, 0.75]  # nominal before there is one


def test_a_resumed_run_films_at_the_next_interval_and_the_posterior_it_had(tmp_path, filmed):
    s = watch(tmp_path, filmed, start=state(1, 5, posterior(0.75)), resumed_at=3)
    s.training(1, {}, state(1, 5))
    assert filmed == []
    s.training(1, {}, state(1, 6))
    s.close()
    assert filmed == [0.75]


def test_rounds_that_come_again_are_dropped(tmp_path, filmed):
    file = tmp_path / session.ROUNDS
    file.write_text('{"round": 1}\n{"round": 2}\n3\n{"rou')
    watch(tmp_path, filmed, start=state(1, 4, posterior(0.75)), resumed_at=3).close()
    assert file.read_text() == '{"round": 1}\n' and not list(tmp_path.glob(".*.tmp"))
