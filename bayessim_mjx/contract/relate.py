"""How numbers that were seen relate to numbers that are expected: order, frame, delay, and one line for each entry."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

Array = NDArray[np.float64]
FLOOR = 1e-6  # share of variance: below it float32 and the digits of a text file decide
TOLD = 0.5  # share of an entry's variance that may be unexplained for its relation to be told; a rule of thumb
BETTER_FRAME = 4.0  # factor by which another frame explains entries better, or a turn; a rule of thumb
BETTER_ORDER = 2.0  # factor by which another order explains the entries that it moves better; a rule of thumb
EXPLAINS = 0.1  # factor by which another source, input or mistake has to leave less to be named; a rule of thumb
CLEAR = 5.0  # times its noise, or its standard error: what stands out; a rule of thumb
BETTER_DELAY = 1.3  # factor by which a delay explains entries better; sampling alone gives 1.1; a rule of thumb
LATE = 0.7  # steps from which on a delay counts: logs may be written half a step after a measurement; rule of thumb
DELAYS = (-1, 0, 1, 2, 3, 4)  # steps by which a state may stand in the log late, all tried; a rule of thumb
ROWS = 12  # rows that a relation needs at least; a rule of thumb
STALE = 0.05  # share of steps with an old value that counts: networks lose one in a hundred; a rule of thumb

PARTS = (0.25, 0.5, 0.75)  # of a step, tried too: a log is written a part of it after a measurement; a rule of thumb
FLAT = 5.0  # degrees, of a turn of axes that is none; a rule of thumb
Reference = Callable[[str, float], "Array | None"]  # (frame, steps of delay) -> [N, g]


@dataclass(frozen=True)
class Relation:
    """How the entries of a group follow from their sources.

    Attributes:
        frame: "" as in the manifest. delay: steps. order: entry i shows source order[i]. left: [g] share of variance
            that is unexplained. expected: [N, g] references by this frame, delay and order. told: [g] bool.
        turn: [3, 3] rotation of axes, where one explains far more than lines do; else None.
        held: steps that a value stays (1: none). stale: share of steps with an old value.
        smooth: share of a new value in a low-pass filter's output; 1: no filter.
    """

    frame: str
    delay: int
    order: tuple[int, ...]
    left: Array
    expected: Array
    told: NDArray[np.bool_]
    turn: Array | None = None
    held: int = 1
    stale: float = 0.0
    smooth: float = 1.0


def unexplained(seen: Array, expected: Array) -> Array:
    """[g, g] share of the variance of seen [N, g] that a line in each of expected [N, g] leaves."""
    x, y = (v - v.mean(0) for v in (expected, seen))
    sizes = np.sqrt(np.outer((y**2).sum(0), (x**2).sum(0)))
    r = np.divide(y.T @ x, sizes, out=np.zeros_like(sizes), where=sizes > 1e-9)
    return np.clip(1.0 - r**2, FLOOR, 1.0)


def relate(
    seen: Array,
    reference: Reference,
    frames: Sequence[str],
    delays: Sequence[int] = DELAYS,
) -> Relation | None:
    """Find frame, delay and order; None where no reference can be computed or too few rows are there.

    Args:
        seen: [N, g]. reference: gives [N, g] or None. frames: other than that of the manifest.
    """
    plain = reference("", 0)
    if plain is None:
        return None
    old, held = staleness(seen, plain)
    fresh = (
        np.append(True, (np.diff(np.nan_to_num(seen), axis=0) != 0).any(1)) if old > STALE else np.ones(len(seen), bool)
    )
    tables: dict[tuple[str, int], Array] = {}
    for frame in ("", *frames):
        for delay in delays:
            expected = reference(frame, delay)
            if expected is None:
                continue
            rows = np.isfinite(seen).all(1) & np.isfinite(expected).all(1) & fresh
            if rows.sum() >= ROWS:
                tables[frame, delay] = unexplained(seen[rows], expected[rows])
    if ("", 0) not in tables:
        return None
    frame, delay = _simplest(tables)
    expected = reference(frame, delay)
    assert expected is not None
    order = order_of(tables[frame, delay])
    left = tables[frame, delay][range(len(order)), order]
    smooth = 1.0
    if old <= STALE and len(delays) > 1:
        first = reference(frame, 0)
        assert first is not None
        smooth = _filtered(seen, first[:, order], left)
        passed = filtered(first, smooth)
        after = _own(seen, passed[:, order])
        if smooth < 1.0 and not _between(seen, reference, frame, order, after):
            delay, expected, left = 0, passed, after
        else:
            smooth = 1.0
    expected = expected[:, order]
    turn = _turn(seen, expected, left, fresh) if seen.shape[1] == 3 else None
    told = left < TOLD if turn is None else np.ones(3, bool)
    return Relation(frame, delay, tuple(order), left, expected, told, turn, held if old > STALE else 1,
                    old if old > STALE else 0.0, smooth)  # fmt: skip


def _own(seen: Array, expected: Array) -> Array:
    """[g] share of the variance of each entry that a line in its own source leaves."""
    rows = np.isfinite(seen).all(1) & np.isfinite(expected).all(1)
    return np.diag(unexplained(seen[rows], expected[rows])) if rows.sum() >= ROWS else np.ones(seen.shape[1])


def _between(seen: Array, reference: Reference, frame: str, order: Sequence[int], filtered_: Array) -> bool:
    """Whether a delay of a part of a step explains the entries about as well as a low-pass filter."""
    for part in PARTS:
        expected = reference(frame, part)
        if expected is None:
            return False
        gain = np.log(_own(seen, expected[:, order])).mean() - np.log(np.maximum(filtered_, FLOOR)).mean()
        if gain < np.log(BETTER_FRAME):
            return True
    return False


def _score(table: Array) -> Array:
    """[g] log of what the best order leaves of each entry."""
    rows, columns = linear_sum_assignment(np.log(table) - 0.05 * np.eye(len(table)))
    return np.log(table[rows, columns])


def _simplest(tables: dict[tuple[str, int], Array]) -> tuple[str, int]:
    """(frame, delay): those of the manifest, unless others explain far more."""
    scores = {key: _score(table) for key, table in tables.items()}
    told = np.min([np.exp(s) for s in scores.values()], axis=0) < TOLD
    if not told.any():
        return "", 0
    total = {key: float(s[told].mean()) for key, s in scores.items()}
    frames = {frame: min(t for (f, _), t in total.items() if f == frame) for frame, _ in total}
    frame = min(frames, key=lambda f: frames[f])
    if frames[frame] > frames[""] - np.log(BETTER_FRAME):
        frame = ""
    of_frame = {d: t for (f, d), t in total.items() if f == frame}
    delay = min(of_frame, key=lambda d: of_frame[d])
    if 0 in of_frame and (of_frame[delay] > of_frame[0] - np.log(BETTER_DELAY) or not _whole(of_frame, delay)):
        delay = 0
    return frame, delay


def _whole(scores: dict[int, float], best: int) -> bool:
    """Whether the lowest point of the unexplained share is at least LATE steps from 0; a parabola through three."""
    if best - 1 not in scores or best + 1 not in scores:
        return best != 0
    before, here, after = (np.exp(scores[best + k]) for k in (-1, 0, 1))
    bend = before - 2 * here + after
    vertex = best + (0.5 * (before - after) / bend if bend > 0 else 0.0)
    return abs(vertex) >= LATE


def order_of(table: Array, factor: float = BETTER_ORDER, told: float = TOLD) -> list[int]:
    """Source of every entry: its own, but for cycles that explain their entries far better in another order."""
    count = len(table)
    _, columns = linear_sum_assignment(np.log(table) - 0.05 * np.eye(count))
    order, own, visited = list(range(count)), np.log(np.diag(table)), set()
    for start in range(count):
        cycle = []
        while start not in visited:
            visited.add(start)
            cycle.append(start)
            start = int(columns[start])
        there = np.array([np.log(table[i, columns[i]]) for i in cycle])
        better = len(cycle) > 1 and own[cycle].sum() - there.sum() > len(cycle) * np.log(factor)
        if better and np.exp(there).max() < told:
            for i in cycle:
                order[i] = int(columns[i])
    return order


def staleness(seen: Array, expected: Array) -> tuple[float, int]:
    """(share of steps in which the value is that of the step before although its source moved, steps it stays)."""
    steps, moves = np.diff(seen, axis=0), np.abs(np.diff(expected, axis=0))
    good = np.isfinite(steps).all(1) & np.isfinite(moves).all(1)
    size = np.abs(steps)
    varies = np.nanmax(size, axis=0, initial=0) > 0
    if good.sum() < ROWS or not varies.any():
        return 0.0, 1
    grain = np.array([s[s > 0].min() if (s > 0).any() else np.inf for s in size[:, varies].T])
    scale = np.nanstd(expected[:, varies], axis=0) / np.maximum(np.nanstd(seen[:, varies], axis=0), 1e-12)
    moved = good & (moves[:, varies] > 2 * grain * scale).any(1)
    same = (size[:, varies] == 0).all(1)
    if moved.sum() < ROWS:
        return 0.0, 1
    share = float(same[moved].mean())
    lengths = np.diff(np.flatnonzero(np.append(True, ~same)))
    held = int(np.median(lengths)) if len(lengths) else 1
    regular = held > 1 and float(np.mean(lengths == held)) > 0.8
    return share, held if regular else 1


def filtered(values: Array, share: float) -> Array:
    """[N, n] after a low-pass filter; it begins anew where a value is not finite."""
    out = np.array(values)
    for k in range(1, len(out)):
        before = np.where(np.isfinite(out[k - 1]), out[k - 1], values[k])
        out[k] = before + share * (values[k] - before)
    return out


def _filtered(seen: Array, expected: Array, left: Array) -> float:
    """Share of the new value where seen is a low-pass filter of expected: y += share (a x + b - y); else 1."""
    shares, gains = [], []
    for y, x, now in zip(seen.T, expected.T, left, strict=True):
        rows = np.isfinite(y[1:]) & np.isfinite(y[:-1]) & np.isfinite(x[1:])
        if rows.sum() < ROWS or np.std(y[1:][rows]) < 1e-9 or np.std(x[1:][rows]) < 1e-9:
            continue
        columns = np.stack([y[:-1][rows], x[1:][rows], np.ones(rows.sum())], 1)
        found, *_ = np.linalg.lstsq(columns, y[1:][rows], rcond=None)
        rest = np.var(y[1:][rows] - columns @ found) / np.var(y[1:][rows])
        alone = unexplained(y[1:][rows][:, None], y[:-1][rows][:, None])[0, 0]  # every slow signal follows itself
        shares.append(1.0 - found[0])
        gains.append(np.log(max(min(now, alone), FLOOR)) - np.log(max(rest, FLOOR)))
    if not shares or np.mean(gains) < np.log(BETTER_FRAME) or np.std(shares) > 0.1:
        return 1.0
    share = float(np.median(shares))
    return share if 0.02 < share < 0.9 else 1.0


def _turn(seen: Array, expected: Array, left: Array, fresh: NDArray[np.bool_]) -> Array | None:
    """[3, 3] rotation with a common factor that explains three axes far better than a line for each does; else None."""
    rows = np.isfinite(seen).all(1) & np.isfinite(expected).all(1) & fresh
    x, y = (v[rows] - v[rows].mean(0) for v in (expected, seen))
    if min(x.std(0).min(), y.std(0).min()) < 1e-9:
        return None
    found, *_ = np.linalg.lstsq(x, y, rcond=None)
    rest = np.var(y - x @ found, axis=0) / np.var(y, axis=0)
    gain = np.log(np.maximum(left, FLOOR)).mean() - np.log(np.maximum(rest, FLOOR)).mean()
    u, sizes, v = np.linalg.svd(found.T)
    turned = u @ v
    if gain < np.log(BETTER_FRAME) or rest.max() > TOLD or sizes.min() < 0.8 * sizes.max() or np.linalg.det(turned) < 0:
        return None
    angle = np.degrees(np.arccos(np.clip((np.trace(turned) - 1) / 2, -1, 1)))
    return turned if angle > FLAT else None
