"""Do commands act before their rows? No drive does, so a lead is a fault of the log; a delay is for effects to explain.

Windows are simulated at shifted commands, and linearised in the shift, the known parameters, the actuators' gains, kp
and kv of servos, and forces of each joint (constant, with position, with speed, with its direction). What remains for
the shift is its own: friction or a wrong damping do not become one.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bayessim_mjx.diagnosis.data_sheet import WORST
from bayessim_mjx.diagnosis.fitting.candidates import STEP
from bayessim_mjx.diagnosis.fitting.discretisation import Discretisation
from bayessim_mjx.diagnosis.fitting.integrator_choice import GAINS
from bayessim_mjx.diagnosis.fitting.quadratic import Quadratic, eliminate
from bayessim_mjx.diagnosis.fitting.substep_errors import Case, Errors
from bayessim_mjx.diagnosis.fitting.windows import Windows
from bayessim_mjx.diagnosis.logcheck.drives import dof_of
from bayessim_mjx.diagnosis.logcheck.timing import SURE
from bayessim_mjx.effects.support.motion import AROUND

Array = NDArray[np.float64]
Shifted = Callable[[float], Windows]  # s -> the windows with commands that act so much later
LEAST = 0.05  # control steps: a simulator's own step may be worth as much; a rule of thumb


@dataclass(frozen=True)
class Shift:
    """When commands act.

    Attributes:
        late: s later than the log says; negative: earlier. error: its standard error.
        apart: s, standard deviation of the conditions' own shifts beyond their errors.
        explains: share of the cost above the noise that the shift alone removes.
        step: s, the control step.
    """

    late: float
    error: float
    apart: float
    explains: float
    step: float

    @property
    def certain(self) -> bool:
        """Whether there is a lead that explains more than all else that is missing does, in all conditions alike."""
        return self._leads(self.error + self.apart)

    @property
    def likely(self) -> bool:
        """Whether there is a lead that explains as much, but by conditions' own shifts beside something else."""
        return self._leads(self.error) and not self.certain

    def _leads(self, error: float) -> bool:
        return -self.late > max(SURE * error, LEAST * self.step) and self.explains > 1 - self.explains

    @property
    def lead(self) -> float:
        """s by which commands are moved: what is certainly a fault of the log; 0 or less."""
        return self.late if self.certain else 0.0

    def notes(self, period: float) -> list[str]:
        """Return the note for the user; period: s between rows of the log."""
        return [self.sentence(period)] if self.certain else [self.hint()] if self.likely else []

    def hint(self) -> str:
        """In words, where the lead is only likely: the logs stay as they are."""
        text = f"commands may act {-1e3 * self.late:.2g} ms (+- {1e3 * self.error:.1g} ms) before their rows"
        return f"{text}, beside a gap of another kind; if so, put `commands_late: {self.late:.4g}` beside the logs"

    def sentence(self, period: float) -> str:
        """Return the finding; period: s between rows of the log."""
        text = f"commands seem shifted by {1e3 * self.late:+.2g} ms (+- {1e3 * self.error:.1g} ms)"
        text += ": they act before their rows, which no drive does; they were moved by as much"
        between = abs(self.late / period + 0.5) < 0.15
        smooth = ", as those of samples of a smooth signal do (`hold: linear`)" if between else ""
        return f"{text}{smooth} (`commands_late: {self.late:.4g}` beside the logs does the same)"


def estimate(step: Discretisation, cuts: Callable[..., Windows], force: Array) -> Shift | None:
    """Return the shift of all commands together, roughly where it is no lead; None: no commands, or the fit has no end.

    Args:
        step: its errors with their start states fitted; its noise is infinite where nothing was measured.
        cuts: (factor on the sub-steps, late=s) -> windows.
        force: `[nv]`, typical size of what acts on each joint.
    """
    errors, sigma = step.errors, step.floor
    if errors is None or not errors.physics.mj_model.nu:
        return None
    factor = min(step.factor, errors.finest)
    cut, model = errors.cut, _Model(errors, lambda s: cuts(factor, late=round(s, 9)), sigma, force, factor)
    precision = np.full(model.size, WORST**-2)
    x, starts = np.zeros(model.size), np.zeros_like(errors.offsets)
    r = model.residual(x, starts)
    A, linear = model.columns(x, starts, r), x  # where the derivatives are those of
    B = errors.columns(sigma)
    noise = model.size / r.size  # share of the cost that as many columns take from noise of the residual's size
    damping = least = 1e-6  # share of the curvature, by Levenberg and Marquardt
    settled = False
    while not settled and abs(x[0]) < 1:
        q, found = eliminate(r, A, B, errors.offsets + starts, cut.spread)
        g, S = q.weighted(np.ones(len(cut)))
        held = S + np.diag(precision + damping * np.diag(S))
        change = np.asarray(np.linalg.solve(held, g - precision * x), np.float64)
        turn = found.step(A, change)
        there = model.residual(x + change, starts + turn)
        cost, gained = float(np.sum(r**2)), float(np.sum(r**2) - np.sum(there**2))
        if gained > 0:  # as much more damped as the columns promised too much (Nielsen, IMM-REP-1999-05, 1999)
            predicted = r - np.einsum("wnk,k->wn", A, change) - np.einsum("wns,ws->wn", B, turn)
            ratio = gained / max(cost - float(np.sum(predicted**2)), gained)
            x, starts, r = x + change, starts + turn, there
            damping = max(damping * max(1 / 6, 1 - (2 * ratio - 1) ** 3), least)
            earliest = AROUND * (float(x[0]) - SURE * abs(float(change[0])))
            settled = gained < noise * cost or earliest > -LEAST * cut.dt
        elif linear is not x:
            A, linear = model.columns(x, starts, r), x
        else:
            damping *= 6
            settled = float(np.abs(change).max()) < STEP
    if abs(x[0]) >= 1:
        return None
    return _judged(eliminate(r, A, B, errors.offsets + starts, cut.spread)[0], x, precision, cut, r.size - starts.size)


class _Model:
    """Whitened residuals `[W, n]` as a function of (shift, parameters, gains, forces), each in units of its scale.

    That of the shift is `AROUND`; of parameters their range, or `WORST` of their value; of servos' own gains (`GAINS`)
    their range; of the commands' gains 1.
    """

    def __init__(self, errors: Errors, late: Shifted, sigma: Array, force: Array, factor: int) -> None:
        self.errors, self.late, self.sigma, self.factor = errors, late, sigma, factor
        space = errors.physics.space
        low, high = (np.array([getattr(p, end) for p in space.parameters]) for end in ("low", "high"))
        self.nominal, self.positive = np.asarray(space.nominal, float), low > 0
        known = np.array([p.kind != "effect" for p in space.parameters], bool) & (self.nominal != 0)
        self.span = np.where(known, np.minimum(high - low, WORST * np.abs(self.nominal)), high - low)
        model = errors.physics.mj_model
        acts = np.ones((4, model.nv), bool)  # but where kp and kv do the same (position, speed), more exactly
        for i, (row, kind) in itertools.product(range(model.nu), enumerate(GAINS, 1)):
            if kind.carries(model, i) and (v := dof_of(model, i)) is not None:
                acts[row, v] = False
        shape, dof = np.nonzero(acts)
        self.forces = (_shapes(errors.cut) * force)[shape, :, :, dof, None] * np.eye(len(force))[dof, None, None]
        self.parts = np.cumsum([1, len(low), model.nu])
        self.size = int(self.parts[-1]) + len(dof)

    def columns(self, x: Array, starts: Array, residual: Array) -> Array:
        """`[W, n, size]`, minus the derivatives of the residuals `[W, n]` at x and starts."""
        there = self._residuals(x + STEP * np.eye(self.size), starts)
        return np.stack([(residual - moved) / STEP for moved in there], -1)

    def residual(self, x: Array, starts: Array) -> Array:
        """Simulate; starts: `[W, 2 nv]`, further changes of the start states."""
        return np.asarray(self._residuals([x], starts)[0])

    def _residuals(self, several: Iterable[Array], starts: Array | None = None) -> Array:
        """`[m, W, n]`."""
        error = self.errors.run_each([self._case(x, starts) for x in several], self.factor)
        return np.asarray(np.clip(error / self.sigma, -1e4, 1e4).reshape(*error.shape[:2], -1))

    def _case(self, x: Array, starts: Array | None) -> Case:
        shift, p, gains, loads = np.split(x, self.parts)
        # beyond its range, as nothing else may; positive ones stay so
        grown = self.nominal * np.exp(np.divide(p * self.span, self.nominal, where=self.positive, out=np.zeros_like(p)))
        theta = np.where(self.positive, grown, self.nominal + p * self.span)
        cut = self.late(AROUND * float(shift[0]))
        command = np.asarray(cut.batch.command) * (1 + np.asarray(gains, np.float32))
        cut = dataclasses.replace(cut, batch=cut.batch.replace(command=command))
        force = np.tensordot(loads, self.forces, 1)
        return Case(cut, starts, theta, force)


def _shapes(cut: Windows) -> Array:
    """`[4, W, H, nv]`, of size 1 at most times: constant, with position, with speed, with the direction of motion.

    Of measured motion, smoothed: the velocity of the logs. A force holds over a control step: the mean of both ends.
    That of its end would lead by half a step, and a servo's wrong damping would look like commands that do.
    Directions are as sure as a velocity is.
    """
    rows = [slice(int(a), int(a) + 1 + cut.steps) for a in cut.start]
    speed = np.stack([cut.logs[log].qvel[own] for log, own in zip(cut.log, rows, strict=True)])
    noise = np.stack([cut.logs[log].sigma_qvel for log in cut.log])[:, None]
    typical = np.maximum(np.sqrt(np.mean(speed**2, (0, 1))), 1e-12)
    travel = np.cumsum(speed, axis=1) * cut.dt
    travel = travel - travel.mean(1, keepdims=True)
    reach = np.maximum(np.abs(travel).max((0, 1)), 1e-12)
    direction = np.tanh(speed / np.maximum(noise, 1e-12))
    ends = np.stack([np.ones_like(speed), travel / reach, speed / typical, direction])
    return np.asarray(0.5 * (ends[:, :, :-1] + ends[:, :, 1:]))


def _judged(q: Quadratic, x: Array, precision: Array, cut: Windows, count: int) -> Shift:
    """At the end of the fit, whose residuals `q` is made of; count: of them, less the start states.

    Parameters farther off than data sheets are is something else that is missing: a drive's dead band came as a lead of
    46 ms beside a body without mass.
    """
    H = q.S.sum(0) + np.diag(precision)
    inverse = np.linalg.pinv(H, hermitian=True)
    robust = inverse @ np.einsum("wi,wj->ij", q.g, q.g) @ inverse
    seen = float(x[0] ** 2 / inverse[0, 0])
    left = max(float(q.c.sum()) - (count - len(x)), 0.0) + max(float(precision[1:] @ x[1:] ** 2) - len(x), 0.0)
    error = float(np.sqrt(max(robust[0, 0], inverse[0, 0])))
    apart = _apart(q, x, precision, cut)
    explains = seen / (seen + left) if seen > 0 else 0.0  # of logs without a gap, nothing
    return Shift(AROUND * float(x[0]), AROUND * error, AROUND * apart, explains, cut.dt)


def _apart(q: Quadratic, x: Array, precision: Array, cut: Windows) -> float:
    """Return the sd of the conditions' own shifts about that of all, as `Shift`, with the other columns free."""
    names = np.unique(cut.group)
    own = (cut.group[:, None] == names).astype(float)  # [W, G]
    cross = np.einsum("wg,wj->gj", own, q.S[:, 0, 1:])
    H = np.block([[np.diag(own.T @ q.S[:, 0, 0]), cross], [cross.T, q.S[:, 1:, 1:].sum(0) + np.diag(precision[1:])]])
    g = np.append(own.T @ q.g[:, 0], q.g[:, 1:].sum(0) - precision[1:] * x[1:])
    inverse = np.linalg.pinv(H, hermitian=True)
    away, errors = (inverse @ g)[: len(names)], np.diag(inverse)[: len(names)]
    return float(np.sqrt(np.mean(np.maximum(away**2 - errors, 0.0))))
