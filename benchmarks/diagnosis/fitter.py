"""The library's side of the comparison with mujoco.sysid: its parameter fit and its single effects, timed in parts."""

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from baselines import extended

from bayessim_mjx.diagnosis.fitting.candidates import Candidate
from bayessim_mjx.diagnosis.fitting.fitter import Fitter
from bayessim_mjx.diagnosis.fitting.robot import of_file
from bayessim_mjx.diagnosis.request import Request
from bayessim_mjx.diagnosis.selection.models import scored
from bayessim_mjx.diagnosis.selection.screen import screen
from bayessim_mjx.diagnosis.selection.search_state import SearchState, ranked
from bayessim_mjx.diagnosis.setup import Setup
from bayessim_mjx.diagnosis.setup import prepare as prepared
from bayessim_mjx.logs import read_logs


def timed(work: Callable[[], Any]) -> tuple[float, Any]:
    """(CPU seconds of all threads, result): other jobs on the same cores do not count."""
    started = time.process_time()
    result = work()
    return time.process_time() - started, result


def prepare(folder: Path, effects: Any, without: str | None) -> tuple[float, float, Setup]:
    """(s to read and cut the logs, s to compile, setup); `without`: an operating condition left out."""

    def read() -> Setup:
        robot = of_file(folder / "model.xml")
        logs = read_logs(folder / "logs", robot.mj_model)
        return prepared(robot, [log for log in logs if log.metadata["condition"] != without], Request(effects))

    reading, setup = timed(read)
    first, _ = timed(lambda: setup.fitter.simulator.run(setup.fitter.theta[None]))
    again, _ = timed(lambda: setup.fitter.simulator.run(setup.fitter.theta[None]))
    return reading, first - again, setup


def fit_base(fitter: Fitter) -> Any:
    """The known parameters, as a diagnosis begins."""
    fit = fitter.begin(fitter.base)
    (fit,) = fitter.iterate([fit], 10, lambda f: range(len(f.coordinates)))
    return fitter.refresh(fit)


def fit(folder: Path, without: str) -> dict:
    """The parameter fit alone. `x`: {name as in truth.json: factor}."""
    reading, compiling, setup = prepare(folder, (), without)
    fitting, fit = timed(lambda: fit_base(setup.fitter))
    names = [f"{p.target}.{p.attribute}" for p in setup.robot.space.parameters]
    return {"prepare": reading, "compile": compiling, "fit": fitting, "x": dict(zip(names, fit.values, strict=True))}


def fit_all(folder: Path) -> tuple[dict, list[Candidate]]:
    """Screening of all candidates and the fits of all singles that could gain, each in its share of the whole."""
    reading, compiling, setup = prepare(folder, "all", None)
    fitter, settings = setup.fitter, setup.settings
    known, fit = timed(lambda: fit_base(fitter))
    model = scored(fitter, fit, ())
    tried = SearchState(fitter, setup.candidates, settings, fit, model)
    screening, tried.screened = timed(lambda: screen(fitter, fit, setup.candidates, settings.screened))
    singles, models = timed(lambda: extended(tried, model, [s for s in tried.screened if s.gain > 0]))
    assert fitter.simulator.traces == 1
    out = {"candidates": len(setup.candidates), "fitted": len(models), "prepare": reading, "compile": compiling}
    out |= {"known": known, "screening": screening, "singles": singles}
    return out | {"seconds": known + screening + singles, "best": ranked(tried, 1)[0].label}, setup.candidates
