"""How far over whole logs: simulated open loop from a log's first window on, as long as a motion can be predicted."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import jax
import numpy as np
from numpy.typing import NDArray

from bayessim_mjx.device import cores
from bayessim_mjx.diagnosis import statistics
from bayessim_mjx.diagnosis.findings import Findings
from bayessim_mjx.diagnosis.fitting import windows
from bayessim_mjx.diagnosis.fitting.simulator import Simulator, physics_of
from bayessim_mjx.diagnosis.selection.budget import Progress
from bayessim_mjx.diagnosis.selection.heldout import Prediction
from bayessim_mjx.diagnosis.selection.models import Model, of_noise, systematic
from bayessim_mjx.diagnosis.setup import Setup
from bayessim_mjx.quantities import percent

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Rules:
    """How much of whole logs is simulated, and what is told of it."""

    # at most
    logs: int = 8
    seconds: float = 10.0
    draws: int = 4  # of the start state
    likely: int = 8  # of start state and parameters together
    lanes: int = 128  # worlds in one call
    # noise sd and share of the motion: what a start's uncertainty may grow to
    clear: float = 3.0
    part: float = 0.1
    least: int = 2  # windows that a log must be predictable for
    lost: float = 999.0  # the simulator's mark of what is not finite


RULES = Rules()
IN_SAMPLE = (
    "over whole logs, {seen} of {logs} are simulated with parameters that were fitted to them too: these errors are in "
    "sample"
)


@dataclass(frozen=True, eq=False)
class Whole:
    """Errors over whole logs, held out but for `in_sample`.

    Attributes:
        cost: {stage: `[L]`}, mean squares in noise variances, of the logs that can be predicted; by_channel: {stage:
            `[L, nv]`}, of positions alone.
        chance: `[L]`, mean squares that come of the uncertain start alone.
        beyond: `[L]`, mean squares of the last stage over those that start, parameters and noise together make likely.
        group: `[L]`, operating conditions; name, seconds: of the horizon; notes: for the warnings.
        in_sample: logs that are simulated with parameters that were fitted to them too.
    """

    cost: dict[str, Array]
    by_channel: dict[str, Array]
    chance: Array
    beyond: Array
    group: NDArray[np.int64]
    name: str
    seconds: float
    notes: tuple[str, ...]
    in_sample: int = 0

    @property
    def over_likely(self) -> float:
        """Times that the last stage's error is as large as is likely: rms, the median of the logs."""
        return float(np.sqrt(np.median(self.beyond)))


@dataclass(frozen=True, eq=False)
class _Stage:
    """A stage of the gap; nominal: with the known parameters as they were delivered."""

    model: Model
    prediction: Prediction
    nominal: bool


def stage(found: Findings, say: Progress) -> Findings:
    """With what every stage of the gap is over whole logs."""
    return found.having(simulate(found))


def simulate(found: Findings) -> Whole:
    """Every stage on at most LOGS logs; parameters are those found without the log's condition, where it has one."""
    setup, cut = found.setup, found.setup.fitter.simulator.windows
    stages = {
        "nominal": _Stage(found.selection.state.base, found.predictions["nominal"], True),
        "calibrated": _Stage(found.selection.state.base, found.predictions["calibrated"], False),
    }
    if found.model.effects:
        stages["with_effects"] = _Stage(found.model, found.predictions["with_effects"], False)
    logs = np.unique(cut.log)
    logs = logs[np.unique(np.linspace(0, len(logs) - 1, min(len(logs), RULES.logs)).round().astype(int))]
    first = [int(np.flatnonzero(cut.log == r)[0]) for r in logs]
    starts = [int(cut.start[w]) for w in first]
    most = round(RULES.seconds / cut.dt)
    length = [min(len(cut.logs[r]) - 1 - a, most) for r, a in zip(logs, starts, strict=True)]
    worlds = len(first) * (len(stages) + RULES.draws + RULES.likely)
    lanes = min(-(-worlds // (cores() if jax.default_backend() == "cpu" else 1)), RULES.lanes)
    simulator = _simulator(found, logs, starts, max(length), lanes)
    errors, spread, likely = [], [], []
    root = _root(found, list(stages.values())[-1].model)
    every = len(stages) + RULES.draws
    for whole, steps in zip(_simulated(found, simulator, stages, root, first), length, strict=True):
        rows = whole[:, :steps]
        errors.append(rows[: len(stages)])
        spread.append(rows[len(stages) : every] - rows[len(stages) - 1])
        likely.append(rows[every:] - rows[len(stages) - 1])
    names = [cut.logs[r].name for r in logs]
    seen = sum(_own_fold(cut, w) is None for w in first)
    return _judged(setup, list(stages), names, cut.condition[first], errors, spread, likely, seen)


def _simulator(found: Findings, logs: Array, starts: list[int], length: int, lanes: int) -> Simulator:
    """Of the named effects only: a small program, compiled in seconds."""
    setup, named = found.setup, {e.effect for e in found.model.effects}
    cut = setup.fitter.simulator.windows
    physics = physics_of(setup.robot, cut.dt, [e for e in setup.physics.effects if e.name in named])
    some = [setup.logs[r] for r in logs]
    where = list(enumerate(starts))
    own = windows.cut(
        some, physics.mj_model, cut.dt, physics.substeps, length, limit=len(some), starts=where, centred=False
    )
    return Simulator(physics, own, lanes)


def _simulated(
    found: Findings, simulator: Simulator, stages: dict[str, _Stage], away: Array, first: Sequence[int]
) -> Array:
    """Whitened errors `[L, stages + draws + likely, H, channels]`, of all logs; `away`: `_root` of the last.

    A step of few worlds takes as long as one of many: most of it is spent on starting the program's parts.
    """
    fitter = found.setup.fitter
    drawn = [_drawn(found, simulator, stages, away, w) for w in first]
    thetas, offsets = (np.concatenate(each) for each in zip(*drawn, strict=True))
    each = len(thetas) // len(first)
    raw = simulator.run_each(thetas, np.arange(len(thetas)), np.repeat(np.arange(len(first)), each), offsets)
    raw[np.abs(raw) >= RULES.lost] = np.nan
    raw = raw.reshape(len(first), each, *raw.shape[1:])
    return np.asarray(raw[..., fitter.used] / fitter.sigma)


def _drawn(
    found: Findings, simulator: Simulator, stages: dict[str, _Stage], away: Array, w: int
) -> tuple[Array, Array]:
    """Thetas `[stages + draws + likely, P]` and changes of the start state `[.., 2 nv]` of the log of window w."""
    fitter, last = found.setup.fitter, list(stages.values())[-1]
    # a key of each log's own: with common draws of the parameters one direction would rule all logs alike
    rng = np.random.default_rng((found.setup.seed, int(found.setup.fitter.simulator.windows.log[w])))
    values = [_values(found, s, w) for s in stages.values()]
    offsets = [s.prediction.offsets[w] for s in stages.values()]
    B = last.model.fit.B[w]
    root = np.linalg.cholesky(np.linalg.inv(B.T @ B + np.diag(1 / fitter.spread**2)))
    moved = offsets[-1] + rng.normal(size=(RULES.draws + RULES.likely, len(root))) @ root.T
    off = values[-1] + rng.normal(size=(RULES.likely, len(values[-1]))) @ away.T
    ends = np.array([(c.low, c.high) for c in last.model.fit.coordinates]).reshape(-1, 2).T
    drawn = [*[values[-1]] * RULES.draws, *np.clip(off, *ends)]
    models = [s.model for s in stages.values()] + [last.model] * len(drawn)
    thetas = np.stack([theta_of(found, simulator, m, v) for m, v in zip(models, [*values, *drawn], strict=True)])
    return thetas, np.concatenate([offsets, moved])


def _root(found: Findings, model: Model) -> Array:
    """Square root `[k, k]` of the covariance of parameters whose law is right: noise, and what simulators differ by."""
    fitter = found.setup.fitter
    own = systematic(model, fitter.simulator.windows.dt, known=True)
    return statistics.root(of_noise(fitter, model) + np.diag(own**2))


def _values(found: Findings, stage: _Stage, w: int) -> Array:
    """Of a stage's coordinates, found without the condition of window w; with all, where the log has several parts."""
    fit = stage.model.fit
    if stage.nominal:
        return np.array([c.neutral for c in fit.coordinates])
    fold = _own_fold(found.setup.fitter.simulator.windows, w)
    return fit.values if fold is None else stage.model.estimates[fold]


def _own_fold(cut: windows.Windows, w: int) -> int | None:
    """Which fold holds all of window w's log out; None where none does, and the log is simulated in sample."""
    own = np.unique(cut.group[cut.log == cut.log[w]])
    return None if cut.blocks or len(own) > 1 else int(np.searchsorted(np.unique(cut.group), own[0]))


def theta_of(found: Findings, simulator: Simulator, model: Model, values: Array) -> Array:
    """theta of the small simulator."""
    space, small = found.setup.physics.space, simulator.physics.space
    return found.setup.fitter.vector(model.fit.coordinates, values)[[space.index(name) for name in small.names]]


def _judged(
    setup: Setup,
    stages: list[str],
    names: list[str],
    group: NDArray[np.int64],
    errors: list[Array],
    spread: list[Array],
    likely: list[Array],
    seen: int,
) -> Whole:
    """Costs of the logs that can be predicted, each as long as it can be, and what is to be said of the others."""
    cut = setup.fitter.simulator.windows
    size = [_motion(setup, name) for name in names]
    last = [_predictable(s, m) for s, m in zip(spread, size, strict=True)]
    chaotic = [n for n, k, e in zip(names, last, errors, strict=True) if k < e.shape[1]]
    broken = [n for n, k, e in zip(names, last, errors, strict=True) if not np.isfinite(e[:, :k]).all()]
    kept = [i for i, n in enumerate(names) if n not in broken and last[i] >= RULES.least * cut.steps]
    cost = {s: np.array([np.mean(errors[i][k, : last[i]] ** 2) for i in kept]) for k, s in enumerate(stages)}
    of = setup.tolerance.by_dof
    each = {s: np.array([np.mean(of(errors[i][k, : last[i]]) ** 2, 0) for i in kept]) for k, s in enumerate(stages)}
    for table in (cost, each):
        table.setdefault("with_effects", table["calibrated"])
    longest = max((last[i] for i in kept), default=0) * cut.dt
    notes = _notes(names, kept, chaotic, broken, longest)
    notes += _away(stages, [[errors[i][k, : last[i]] / size[i] for i in kept] for k in range(len(stages))])
    whole = not chaotic and longest < RULES.seconds - cut.dt
    return Whole(
        cost=cost,
        by_channel=each,
        chance=np.array([np.mean(spread[i][:, : last[i]] ** 2) for i in kept]),
        beyond=np.array([_beyond(errors[i][-1, : last[i]], likely[i][:, : last[i]]) for i in kept]),
        group=group[kept],
        name="whole log" if whole else f"up to {longest:.2g} s",
        seconds=float(np.median([last[i] for i in kept]) * cut.dt) if kept else 0.0,
        notes=(*notes, *([IN_SAMPLE.format(seen=seen, logs=len(names))] if seen else [])),
        in_sample=seen,
    )


def _beyond(error: Array, likely: Array) -> float:
    """Mean square of a log's error over what draws of start and parameters leave of the mean, and noise, have."""
    with np.errstate(invalid="ignore"):
        each = np.mean(likely**2, axis=(1, 2))
    return float(np.mean(error**2) / (1.0 + np.mean(each[np.isfinite(each)]))) if np.isfinite(each).any() else 0.0


def _motion(setup: Setup, name: str) -> Array:
    """Standard deviation of the measured motion `[channels]`, in noise standard deviations."""
    log = next(log for log in setup.fitter.simulator.windows.logs if log.name == name)
    model = setup.physics.mj_model
    moved = np.concatenate([log.qvel, log.qvel], axis=1)
    if model.nq == model.nv:
        moved[:, : model.nv] = log.qpos
    else:  # quaternions: the path travelled stands for the coordinates
        moved[:, : model.nv] = np.cumsum(log.qvel, axis=0) * log.period
    return np.maximum(np.std(moved, axis=0)[setup.fitter.used] / setup.fitter.sigma, RULES.clear / RULES.part)


def _predictable(spread: Array, size: Array) -> int:
    """Control steps until the start's uncertainty has grown to a part of the motion (or left what is finite)."""
    with np.errstate(invalid="ignore"):
        grown = np.sqrt(np.mean((spread / size) ** 2, axis=(0, 2)))
    far = np.flatnonzero(~(grown < RULES.part))
    return int(far[0]) if len(far) else spread.shape[1]


def _notes(names: list[str], kept: list[int], chaotic: list[str], broken: list[str], longest: float) -> list[str]:
    out = []
    if chaotic:
        used = f"they count up to there (at most {longest:.2g} s)" if kept else "no horizon beyond the windows is given"
        which = f"{len(chaotic)} of {len(names)} logs ({', '.join(chaotic[:4])})"
        out.append(
            f"unstable or chaotic motion: in {which} the uncertainty of the start alone grows to {percent(RULES.part)} "
            f"of the motion, so no simulator can predict them whole; {used}"
        )
    if broken:
        which = f"{len(broken)} of {len(names)} logs ({', '.join(broken[:4])})"
        out.append(f"simulated open loop, {which} diverge: left out of the longest horizon")
    return out


def _away(stages: list[str], errors: list[list[Array]]) -> list[str]:
    """Stages whose error is larger than the motion itself."""
    words = {"nominal": "as delivered", "calibrated": "recalibrated", "with_effects": "with the effects"}
    lost = {words[s]: sum(float(np.mean(e**2)) > 1.0 for e in each) for s, each in zip(stages, errors, strict=True)}
    found = ", ".join(f"{name} in {count} of {len(errors[0])}" for name, count in lost.items() if count)
    text = f"over whole logs the simulator leaves the measured motion altogether ({found}): there the size of its error"
    return [f"{text} says little"] if found else []
