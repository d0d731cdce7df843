"""`rl.train` and `loop.run` show progress where a person watches, by an argument, and else print nothing."""

import dataclasses
from typing import Any

import jax
import numpy as np
import pytest

from bayessim_mjx import cli, loop, progress, rl
from bayessim_mjx.distributions import Distribution
from bayessim_mjx.loop import watching
from tests.commands.toy_runs import LOOP, SMALL, TOY


def settings() -> Any:
    """One round, without inference, which takes long to compile."""
    words = ["--task", "Pendulum", *SMALL, *LOOP, "bayessim.realIters=1", "bayessim.modelClass=None"]
    return cli.config_of(cli.Parser("main", "").parse(words))


def test_training_is_silent_in_a_pipe_and_shows_iterations_to_a_person(capsys: Any, monkeypatch: Any) -> None:
    ppo = dataclasses.replace(settings().ppo, max_iterations=2)
    rl.train(TOY, ppo, jax.random.PRNGKey(0))
    assert capsys.readouterr() == ("", "")
    monkeypatch.setattr(progress, "watched", lambda: True)
    rl.train(TOY, ppo, jax.random.PRNGKey(0), progress=False)
    assert capsys.readouterr() == ("", "")
    rl.train(TOY, ppo, jax.random.PRNGKey(0))
    assert "training: 0 of 2" in capsys.readouterr().err
    seen = []
    rl.train(TOY, ppo, jax.random.PRNGKey(0), progress=lambda metrics, state: seen.append(int(state.iteration)))
    assert seen == [1, 2] and capsys.readouterr() == ("", "")


def test_the_loop_shows_the_parts_of_a_round_and_its_result(capsys: Any, monkeypatch: Any) -> None:
    parts = loop.make(settings(), TOY)
    monkeypatch.setattr(progress, "watched", lambda: True)
    _, [info] = loop.run(parts, loop.init(parts))
    err = capsys.readouterr().err
    assert "round 1/1: training: 0 of 4" in err and "round 1/1: evaluating the policy" in err
    assert err.splitlines()[-1].startswith("round 1/1: return ") and info.posterior is None
    monkeypatch.setattr(progress, "watched", lambda: False)
    loop.run(parts, loop.init(parts))
    assert capsys.readouterr() == ("", "")


def test_the_line_of_a_round_has_return_and_posterior(monkeypatch: Any) -> None:
    numbers = {
        "returns": np.array([-80.0, -90.0]),
        "posterior": Distribution.prior(TOY.space),
        "seconds": {"fit": 65.0},
    }
    empty = dict.fromkeys(f.name for f in dataclasses.fields(loop.RoundInfo))
    info = loop.RoundInfo(**{**empty, "round": 0, "rounds": 2, **numbers})
    line = watching.line_of(info)
    assert line == "round 1/2: return -85.0 ± 5.0, 1 min 05 s, mass 1.25 ± 0.51"  # 68 % of [0.5, 2]: 0.74 to 1.76
    monkeypatch.setenv("COLUMNS", "50")
    assert watching.line_of(info) == "round 1/2: return -85.0 ± 5.0, 1 min 05 s ..."


def test_a_monitor_takes_the_place_of_progress(capsys: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    class Monitor:
        rounds = 0

        def training(self, round_: int, metrics: Any, state: Any) -> None: ...

        def round(self, info: Any, policy: Any) -> None:
            self.rounds += 1

    class Listener(Monitor):
        parts = ()

        def part(self, round_: int, name: str) -> None:
            self.parts += ((round_, name),)

    monkeypatch.setattr(progress, "watched", lambda: True)
    monitor, parts = Monitor(), loop.make(settings(), TOY)
    loop.run(parts, loop.init(parts, progress=False), monitor=monitor)
    assert monitor.rounds == 1 and capsys.readouterr() == ("", "")
    loop.run(parts, loop.init(parts, progress=False), monitor=(listener := Listener()))
    assert listener.parts == ((0, "evaluating the policy"),)
