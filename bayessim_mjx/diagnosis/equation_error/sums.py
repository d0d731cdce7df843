"""All logs as sums of products: everything after one pass over the data is algebra on small matrices."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import mujoco
import numpy as np
from numpy.typing import NDArray

from bayessim_mjx.diagnosis.equation_error.columns import LIMITS, Layout, columns, layout_of, sources
from bayessim_mjx.logs.log import Log

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Budget:
    """How much is looked at, and in how many parts logs are held out."""

    rows: int = 12000  # of all logs together, at their own rates
    folds: int = 3  # with fewer logs, each is cut into parts
    parts: int = 4
    most: int = 12  # parts of all logs together: those of more logs are held out side by side
    least: float = 6.0  # independent rows of a joint in a part


BUDGET = Budget()


@dataclass(frozen=True, eq=False)
class Sums:
    """Products of the columns, `gram` `[F, nv, P, P]` by parts, each row counted as so many independent ones.

    Attributes:
        rows: `[F, nv]`, independent rows; source: `[nv]`, where the effort comes from (`columns.sources`).
        period: s between the logs' rows.
    """

    layout: Layout
    gram: Array
    rows: Array
    source: tuple[str, ...]
    period: float

    @cached_property
    def whole(self) -> Array:
        """`[nv, P, P]` of all parts."""
        return np.asarray(self.gram.sum(0))

    def power(self, column: int) -> Array:
        """`[nv]`, mean square of a column."""
        return np.asarray(self.whole[:, column, column] / np.maximum(self.rows.sum(0), 1e-9))

    @cached_property
    def size(self) -> Array:
        """`[nv]`, rms of the effort, measured or needed; where nothing drives a joint, of what acts on it."""
        lay = self.layout
        return np.sqrt(np.max([self.power(c) for c in (lay.effort, lay.known, lay.own("load"))], axis=0))


def gather(logs: Sequence[Log], model: mujoco.MjModel) -> Sums:
    """The sums of logs that move; joints whose effort is not known in all of them are left out."""
    each = [sources(log, model) for log in logs]
    source = tuple(_common(s) for s in zip(*each, strict=True))
    layout = layout_of(model)
    short = _shortened(logs)
    top = np.max([np.percentile(np.abs(log.qvel), 95, axis=0) for log in short], axis=0)
    grams, rows = [], []
    parts = BUDGET.parts if len(short) < BUDGET.folds else 1
    for log in short:
        own = columns(log, model, source, LIMITS.slow * top + 1e-12)
        for part in np.array_split(np.arange(own.rows.shape[1]), parts):
            gram = np.zeros((model.nv, layout.size, layout.size))
            count = np.zeros(model.nv)
            for v in range(model.nv):
                x = own.x[part[own.rows[v, part]], v]
                gram[v], count[v] = own.share * x.T @ x, own.share * len(x)
            grams.append(gram)
            rows.append(count)
    period = float(np.median([log.period for log in logs]))
    return Sums(layout, _in_parts(grams), _in_parts(rows), source, period)


def _in_parts(each: Sequence[Array]) -> Array:
    """Sums of neighbours, at most `BUDGET.most`."""
    ends = np.linspace(0, len(each), min(len(each), BUDGET.most) + 1).round().astype(int)
    return np.array([np.sum(each[a:b], 0) for a, b in itertools.pairwise(ends)])


def _common(each: Sequence[str]) -> str:
    """The source that all logs have."""
    if len(set(each)) == 1:
        return each[0]
    return "ctrl" if set(each) == {"ctrl", "effort"} else ""


def _shortened(logs: Sequence[Log]) -> list[Log]:
    """The middle parts of logs that are too long together."""
    share = BUDGET.rows / max(sum(len(log) for log in logs), 1)
    if share >= 1:
        return list(logs)
    spans = [(len(log), max(int(share * len(log)), min(len(log), 200))) for log in logs]
    return [log.cut((n - k) // 2, (n + k) // 2) for log, (n, k) in zip(logs, spans, strict=True)]
