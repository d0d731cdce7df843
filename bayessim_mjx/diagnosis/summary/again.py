"""The answer simulated again: open loop over whole logs, and at finer time steps.

Whole logs: as long as the uncertain start alone stays within the tolerance, beyond which no simulator can predict them.

Finer steps: a fit takes part of the integrator's error into its parameters. The posterior's mode at a quarter of the
step, on the same windows, shows three quarters of an error that is proportional to the step.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bayessim_mjx.diagnosis import statistics
from bayessim_mjx.diagnosis.experiment.propose import SIZE
from bayessim_mjx.diagnosis.findings import Findings
from bayessim_mjx.diagnosis.fitting import windows
from bayessim_mjx.diagnosis.fitting.delivered import Delivered
from bayessim_mjx.diagnosis.fitting.discretisation import FACTORS, refined
from bayessim_mjx.diagnosis.fitting.robot import contacts
from bayessim_mjx.diagnosis.fitting.simulator import FAR, Simulator, physics_of
from bayessim_mjx.diagnosis.phrases import notes
from bayessim_mjx.diagnosis.request import Tolerance
from bayessim_mjx.diagnosis.selection.models import Model, of_noise, systematic
from bayessim_mjx.diagnosis.selection.numbers import Progress
from bayessim_mjx.diagnosis.setup import Setup
from bayessim_mjx.physics import Physics, staggered

Array = NDArray[np.float64]
# Whole logs at most, each as long as an experiment (`SIZE.seconds`), and draws of the start, as many again of start and
# parameters: seconds alone; a rule of thumb
SEVERAL = 8
FINER = FACTORS[-1]  # times as many steps as the fit took: the rest of the error, of first order, is extrapolated


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


def over_whole_logs(found: Findings, say: Progress) -> Findings:
    """Add the errors of every stage of the gap over whole logs."""
    return found.having(whole_logs(found))


def whole_logs(found: Findings) -> Whole:
    """Simulate every stage on at most SEVERAL logs; without the log's condition in the fit, where it has one."""
    setup, cut = found.setup, found.setup.fitter.simulator.windows
    stages = [s for s in found.predictions if s != "with_effects" or found.model.effects]
    logs = np.unique(cut.log)
    logs = logs[np.unique(np.linspace(0, len(logs) - 1, min(len(logs), SEVERAL)).round().astype(int))]
    first = [int(np.flatnonzero(cut.log == r)[0]) for r in logs]
    starts = [int(cut.start[w]) for w in first]
    length = [min(len(cut.logs[r]) - 1 - a, round(SIZE.seconds / cut.dt)) for r, a in zip(logs, starts, strict=True)]
    chains = _chains(setup, logs, starts, max(length))
    every = _simulated(found, chains, stages, first)
    errors = [own[:, :steps] for own, steps in zip(every, length, strict=True)]
    seen = sum(_own_fold(cut, w) is None for w in first)
    return _judged(setup, stages, [cut.logs[r].name for r in logs], cut.condition[first], errors, seen)


def _chains(setup: Setup, logs: Array, starts: Sequence[int], length: int) -> windows.Windows:
    """Windows that follow each other over each log, as many for each; beyond a log's end its last row is held."""
    cut = setup.fitter.simulator.windows
    ahead = range(0, length, cut.steps)
    each = [(int(r), min(a + k, len(cut.logs[r]) - 1)) for r, a in zip(logs, starts, strict=True) for k in ahead]
    return _cut(setup, setup.physics, each)


def _cut(setup: Setup, physics: Physics, starts: list[tuple[int, int]], many: int = 1) -> windows.Windows:
    """Windows of the setup's length, or of many of it, at these (log, row)."""
    cut = setup.fitter.simulator.windows
    return windows.cut(
        setup.logs,
        physics.mj_model,
        cut.dt,
        physics.substeps,
        cut.steps * many,
        limit=len(starts),
        starts=starts,
        centred=False,
    )


def _simulated(found: Findings, chains: windows.Windows, stages: Sequence[str], first: Sequence[int]) -> Array:
    """Whitened errors `[L, stages + 2 SEVERAL, H, channels]` of all logs; first: a window of each."""
    fitter = found.setup.fitter
    last = _model(found, stages[-1])
    # a right law's parameters differ by noise, and by as much as two simulators
    own = np.diag(systematic(last, fitter.simulator.windows.dt, known=True) ** 2)
    law = statistics.root(of_noise(fitter, last) + own)
    drawn = [_drawn(found, stages, law, w) for w in first]
    thetas, offsets = (np.concatenate(each) for each in zip(*drawn, strict=True))
    chain = np.repeat(np.arange(len(chains)).reshape(len(first), -1), len(thetas) // len(first), axis=0)
    raw = fitter.simulator.run_on(thetas, offsets, chains, chain)
    raw = raw.reshape(len(first), -1, *raw.shape[1:])
    if found.setup.delivered is not None:
        raw[:, stages.index("nominal")] = _as_delivered(found, found.setup.delivered, first, chain.shape[1])
    raw[np.abs(raw) >= FAR] = np.nan
    return np.asarray(raw[..., fitter.used] / fitter.sigma)


def _as_delivered(found: Findings, delivered: Delivered, first: Sequence[int], many: int) -> Array:
    """Errors `[L, H, 2 nv]` of the model as delivered on the logs of these windows, by the commands that are nearer."""
    setup, fitter = found.setup, found.setup.fitter
    cut = fitter.simulator.windows
    starts = [(int(cut.log[w]), int(cut.start[w])) for w in first]
    cuts, moved = [_cut(setup, setup.physics, starts, many)], setup.gate.timing.moved
    cuts += [delivered.recorded(starts, cut, setup.logs, moved, many)] if moved else []
    played = [delivered.played(own, found.predictions["nominal"].offsets[first]) for own in cuts]
    return min(played, key=lambda errors: float(np.sum(fitter.whiten(errors[:, : cut.steps]) ** 2)))


def _drawn(found: Findings, stages: Sequence[str], law: Array, w: int) -> tuple[Array, Array]:
    """Thetas `[stages + 2 SEVERAL, P]` and changes of the start state `[.., 2 nv]` of the log of window w.

    The first draws are of the start alone, the last of start and parameters, whose covariance has the root `law`.
    """
    fitter, cut = found.setup.fitter, found.setup.fitter.simulator.windows
    # a key of each log's own: with common draws of the parameters one direction would rule all logs alike
    rng = np.random.default_rng((found.setup.seed, int(cut.log[w])))
    models = [_model(found, s) for s in stages]
    values = [_values(found, s, w) for s in stages]
    offsets = [found.predictions[s].offsets[w] for s in stages]
    B, last = models[-1].fit.B[w], models[-1]
    start = np.linalg.cholesky(np.linalg.inv(B.T @ B + np.diag(1 / last.fit.spread**2)))
    moved = offsets[-1] + rng.normal(size=(SEVERAL, len(start))) @ start.T
    off = values[-1] + rng.normal(size=(SEVERAL, len(values[-1]))) @ law.T
    ends = np.array([(c.low, c.high) for c in last.fit.coordinates]).reshape(-1, 2).T
    each = zip([*models, *[last] * 2 * SEVERAL], [*values, *[values[-1]] * SEVERAL, *np.clip(off, *ends)], strict=True)
    return np.stack([fitter.vector(m.fit.coordinates, v) for m, v in each]), np.concatenate([offsets, moved, moved])


def _model(found: Findings, stage: str) -> Model:
    return found.model if stage == "with_effects" else found.selection.state.base


def _values(found: Findings, stage: str, w: int) -> Array:
    """Of a stage's coordinates, found without the condition of window w; with all, where the log has several parts."""
    model, fold = _model(found, stage), _own_fold(found.setup.fitter.simulator.windows, w)
    if stage == "nominal":
        return np.array([c.neutral for c in model.fit.coordinates])
    return model.fit.values if fold is None else model.estimates[fold]


def _own_fold(cut: windows.Windows, w: int) -> int | None:
    """Which fold holds all of window w's log out; None where none does, and the log is simulated in sample."""
    own = np.unique(cut.group[cut.log == cut.log[w]])
    return None if cut.blocks or len(own) > 1 else int(np.searchsorted(np.unique(cut.group), own[0]))


def _judged(
    setup: Setup, stages: list[str], names: list[str], group: NDArray[np.int64], errors: list[Array], seen: int
) -> Whole:
    """Costs of the logs that can be predicted, each as long as it can be, and notes on the others.

    Args:
        errors: `[stages + 2 SEVERAL, H, channels]` of each log; seen: logs that are simulated in sample.
    """
    cut, allowed, count = setup.fitter.simulator.windows, setup.tolerance, len(stages)
    start, law = slice(count, count + SEVERAL), slice(count + SEVERAL, None)
    last = [predictable(e[start] - e[count - 1], allowed) for e in errors]
    chaotic = [n for n, k, e in zip(names, last, errors, strict=True) if k < e.shape[1]]
    broken = [n for n, k, e in zip(names, last, errors, strict=True) if not np.isfinite(e[:count, :k]).all()]
    kept = [i for i, n in enumerate(names) if n not in broken and last[i] > cut.steps]
    long = [errors[i][:, : last[i]] for i in kept]
    cost = {s: np.array([np.mean(e[k] ** 2) for e in long]) for k, s in enumerate(stages)}
    each = {s: np.array([np.mean(allowed.by_dof(e[k]) ** 2, 0) for e in long]) for k, s in enumerate(stages)}
    away = {s: sum(_leaves(own, allowed) for own in each[s]) for s in stages}
    for table in (cost, each):
        table.setdefault("with_effects", table["calibrated"])
    longest = max((last[i] for i in kept), default=0) * cut.dt
    return Whole(
        cost=cost,
        by_channel=each,
        chance=np.array([np.mean((e[start] - e[count - 1]) ** 2) for e in long]),
        beyond=np.array([beyond(e[count - 1], e[law] - e[count - 1]) for e in long]),
        group=group[kept],
        name="whole log" if not chaotic and longest < SIZE.seconds - cut.dt else f"up to {longest:.2g} s",
        seconds=float(np.median([last[i] for i in kept]) * cut.dt) if kept else 0.0,
        notes=tuple(notes.whole_logs(names, chaotic, broken, longest, away, len(kept), seen)),
        in_sample=seen,
    )


def predictable(spread: Array, allowed: Tolerance) -> int:
    """Control steps until the start's uncertainty exceeds the tolerance of a joint (or is no longer finite).

    Args:
        spread: `[draws, H, channels]`, differences that the uncertain start makes, in noise standard deviations.
    """
    seen = np.isfinite(allowed.noise)
    with np.errstate(invalid="ignore", over="ignore"):
        grown = np.sqrt(np.mean(allowed.by_dof(spread) ** 2, axis=0)) * allowed.noise
    far = np.flatnonzero((~(grown <= np.maximum(allowed.limit, allowed.noise)))[:, seen].any(1))
    return int(far[0]) if len(far) else spread.shape[1]


def beyond(error: Array, likely: Array) -> float:
    """Mean square of a log's error over that of noise and of draws of start and parameters about the mean."""
    with np.errstate(invalid="ignore"):
        each = np.mean(likely**2, axis=(1, 2))
    return float(np.mean(error**2) / (1.0 + np.mean(each[np.isfinite(each)]))) if np.isfinite(each).any() else 0.0


def _leaves(squares: Array, allowed: Tolerance) -> bool:
    """Whether errors `[nv]`, in noise variances, are larger than the motion's amplitude, rms over the joints."""
    moves = (allowed.motion > 0) & np.isfinite(squares)
    return bool(moves.any() and np.mean(squares[moves] * (2 * allowed.noise / allowed.motion)[moves] ** 2) > 1.0)


@dataclass(frozen=True, eq=False)
class AtFinerSteps:
    """`shift`: `[k]`, what the values of the model's coordinates would change by at ever finer steps."""

    shift: Array

    def covariance(self, known: int) -> Array:
        """`[k, k]`, of all parameters together: known ones are moved by the shift, whose last part is extrapolated.

        Effects' numbers stay, as those of a simulator with this step, and are off by it one way or the other.
        """
        off = np.where(np.arange(len(self.shift)) < known, self.shift / FINER, self.shift)
        return np.outer(off, off)

    def notes(self, model: Model, together: Array) -> list[str]:
        """Make the notes for the warnings; together: `[k, k]`, covariance without it."""
        own = {c.name for effect in model.effects for c in effect.coordinates}
        each = zip(model.fit.coordinates, model.fit.values, self.shift, np.sqrt(np.diag(together)), strict=True)
        return notes.finer_steps((c.name, v, shift, c.unit, sd) for c, v, shift, sd in each if c.name in own)


def at_finer_steps(found: Findings, say: Progress) -> Findings:
    """Add the change at finer steps; nothing where something can touch, or by an integrator of higher order."""
    if not staggered(found.setup.robot.mj_model) or contacts(found.setup.physics):
        return found
    shift = _shift(found)
    return found if shift is None else found.having(AtFinerSteps(shift))


def _shift(found: Findings) -> Array | None:
    """Of the coordinates; None where finer steps cannot be simulated."""
    fit, fitter = found.model.fit, found.setup.fitter
    simulator = _finer(found)
    space, small = found.setup.physics.space, simulator.physics.space
    theta = fitter.vector(fit.coordinates, fit.values)[[space.index(name) for name in small.names]]
    errors = simulator.run(theta[None], fit.offsets[None])
    if np.abs(errors).max() >= FAR:
        return None
    step = found.selection.estimated.step
    return (step(fitter.whiten(errors)[0]) - step(fit.r)) * FINER / (FINER - 1)


def _finer(found: Findings) -> Simulator:
    """Return the windows at finer steps, with the named effects only: a small program."""
    setup, named = found.setup, {e.effect for e in found.model.effects}
    cut, step = setup.fitter.simulator.windows, float(setup.robot.mj_model.opt.timestep)
    effects = [e for e in setup.physics.effects if e.name in named]
    physics = physics_of(refined(setup.robot, step / FINER), cut.dt, effects)
    return Simulator(physics, _cut(setup, physics, list(zip(cut.log.tolist(), cut.start.tolist(), strict=True))))
