"""Time stamps that are numbers: in which unit they are, and rows that follow each other evenly behind coarse stamps."""

from __future__ import annotations

import warnings
from datetime import datetime

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from bayessim_mjx.errors import UserError
from bayessim_mjx.logs import units
from bayessim_mjx.logs.instants import DAY
from bayessim_mjx.logs.log import Array
from bayessim_mjx.logs.table import Table

SINCE = (946684800.0, 4102444800.0)  # s since 1970: 2000 to 2100
# the same in days since 1900 (spreadsheets) or 1858 (MJD), since the year 0 (MATLAB), and since 4713 BC (Julian)
DAYS = ((36526.0, 88070.0), (730486.0, 767011.0), (2451544.0, 2488070.0))
TICKS = (-11644473600.0, -62135596800.0)  # s since 1970 at which Windows and .NET begin to count 100 ns
PERIODS = (1e-4, 1.0)  # s between rows of a log of a robot; rule of thumb, not measured
WINDOW = 7  # rows through which a parabola is put; rule of thumb, not measured


def seconds_of(raw: Array, table: Table, column: str, suffix: str = "") -> Array:
    """Stamps [T] whose unit nobody stated, as seconds.

    Stamps since 1970 in ms, us or ns, days of a spreadsheet, and a unit at the end of the column's name are taken where
    no other reading has a period of `PERIODS`. All other stamps are seconds, with a warning where ms would fit too.

    Args:
        suffix: text behind each number.

    Raises:
        UserError: two readings fit, or digits of a date.
    """
    seen = raw[np.isfinite(raw)]
    if len(seen) < 2:
        return raw
    steps = np.diff(seen)
    step = float(np.median(steps[steps > 0])) if (steps > 0).any() else 0.0
    start = float(seen[0])
    for unit in ("ms", "us", "ns"):
        scale = units.TIMES[unit]
        if SINCE[0] <= start * scale <= SINCE[1] and (_period(step * scale) or not step):
            _say(table, column, f"{unit} since 1970", unit)
            return raw * scale
    if any(a <= start <= b for a, b in DAYS) and step < 1.2e-5 and _period(step * units.TIMES["days"]):
        _say(table, column, "days of a spreadsheet or calendar", "days")
        return (raw - start) * units.TIMES["days"]
    if any(SINCE[0] <= 1e-7 * start + since <= SINCE[1] for since in TICKS):
        key = f"`time: {{column: {column!r}, scale: 1.0e-07}}`"
        raise UserError(
            f"{table.path}: column {column!r}: {start:.0f} counts 100 ns, as Windows does; state {key} in a map"
        )
    if _written_out(start):
        key = f"`time: {{column: {column!r}, format: '%Y%m%d%H%M%S.%f'}}`"
        raise UserError(
            f"{table.path}: column {column!r}: {start:.0f} reads as a date without marks; state {key} in a map"
        )
    check_digits(raw, table, column)
    named = units.of_name(f"[{suffix.strip()}]") or (None if column == "time" else units.of_name(column))
    unit = named or "s"
    if unit not in units.TIMES:
        return raw
    if unit != "s":
        return _named(raw, step, table, column, unit)
    if step == 1.0 and (seen == np.floor(seen)).all() and (steps > 0).all():
        raise UserError(f"{_doubt(table, column, 'ms')}: whole numbers that grow by 1")
    if named is None and _period(step) and _period(step * units.TIMES["ms"]):
        text = f"{table.path}: column {column!r} has a row every {step:.4g} s; if it is in ms, `time: {{column: "
        warnings.warn(f"{text}{column!r}, unit: ms}}` in a map says so, and `unit: s` if not", stacklevel=6)
    return raw


def _written_out(start: float) -> bool:
    """Whether a number is a date from 2000 to 2099 written as year, month, day, hours, minutes and seconds."""
    try:
        return datetime.strptime(f"{start:.0f}", "%Y%m%d%H%M%S").year // 100 == 20
    except ValueError:
        return False


def check_counter(raw: Array, table: Table, column: str) -> None:
    """Stamps do not run over: counters of 16, 24 or 32 bits, and clocks of a day or a week, begin at 0 again.

    Raises:
        UserError: they do; names the key `wrap`.
    """
    seen = raw[np.isfinite(raw)]
    steps = np.diff(seen)
    back = steps[steps < 0]
    if not len(back):
        return
    forward, largest = float(steps.max()), float(np.abs(seen).max())
    counters = {float(2**bits): f"a counter of {bits} bits" for bits in (16, 24, 32)} if (seen % 1 == 0).all() else {}
    clocks = {days * DAY / units.TIMES[u]: f"a clock of a {what} in {u}" for days, what in ((1, "day"), (7, "week"))
              for u in ("s", "ms", "us", "ns")}  # fmt: skip
    for period, what in (counters | clocks).items():
        signed = seen.min() < 0 and what.startswith("a counter")
        if (
            largest <= (0.5 if signed else 1.0) * period
            and ((back + period > 0) & (back + period <= 2.0 * forward)).all()
        ):
            text = f"{table.path}: column {column!r} runs back by {-back[0]:.9g}, as {what} does"
            raise UserError(f"{text}; `time: {{column: {column!r}, wrap: {period:.0f}}}` in a map lets it go on")


def check_digits(raw: Array, table: Table, column: str) -> None:
    """Stamps are no times of day that are written as digits, hhmmss.ss, as NMEA does: 101559.99 and then 101600.00.

    Raises:
        UserError: they are; names the key `format`.
    """
    seen = raw[np.isfinite(raw)]
    if len(seen) < 3 or not ((seen >= 0) & (seen < 240000) & (seen % 100 < 60) & (seen // 100 % 100 < 60)).all():
        return
    seconds = seen // 10000 * 3600 + seen // 100 % 100 * 60 + seen % 100
    steps, plain = np.diff(seconds), np.diff(seen)
    jumps = plain - steps > 1.0  # where the digits of the seconds begin again
    if jumps.any() and (steps > 0).all() and _period(float(np.median(steps))) and steps[jumps].max() < 1.0:
        text = f"{table.path}: column {column!r} reads as hours, minutes and seconds without marks ({seen[0]:.2f})"
        raise UserError(f"{text}; state `time: {{column: {column!r}, format: '%H%M%S.%f'}}` in a map")


def _period(step: float) -> bool:
    return PERIODS[0] <= step <= PERIODS[1]


def _say(table: Table, column: str, what: str, unit: str) -> None:
    text = f"{table.path}: column {column!r} is read as {what}; `time: {{column: {column!r}, unit: {unit}}}` says so"
    warnings.warn(text, stacklevel=7)


def _doubt(table: Table, column: str, unit: str) -> str:
    keys = f"`time: {{column: {column!r}, unit: {unit}}}` or `time: {{column: {column!r}, unit: s}}` in a map"
    return f"{table.path}: column {column!r} may be in {unit} or in s; state {keys}"


def _named(raw: Array, step: float, table: Table, column: str, unit: str) -> Array:
    """Convert stamps of a column whose name bears a unit other than the second."""
    scale = units.TIMES[unit]
    if _period(step * scale) and not _period(step):
        _say(table, column, f"{unit}, as its name says", unit)
        return raw * scale
    raise UserError(f"{_doubt(table, column, unit)}: its name says {unit}, and its median step is {step:.4g}")


def even(raw: Array, rate: float, table: Table, column: str) -> Array:
    """Return times [T] of rows that go on at `rate` [1/s], from stamps that are too coarse or come too late.

    Raises:
        UserError: stamps with another rate, or with a gap.
    """
    seen = np.flatnonzero(np.isfinite(raw))
    time = raw[seen[0]] + (np.arange(len(raw)) - seen[0]) / rate if len(seen) else raw.copy()
    time = np.where(np.isfinite(raw), time, np.nan)
    if len(seen) < 3:
        return time
    span, rows = float(raw[seen[-1]] - raw[seen[0]]), int(seen[-1] - seen[0])
    grain = coarseness(raw[seen])
    at = f"{table.path}: column {column!r}"
    if span <= 0 or not (span - grain) * rate <= 1.02 * rows + 1 or not (span + grain) * rate >= 0.98 * rows - 1:
        found = f"{rows / span:.6g} rows per second" if span > 0 else "no time between the first and the last row"
        raise UserError(
            f"{at}: its stamps give {found}, `rate: {rate:g}` of the map tells {rate:g}; allowed: their rate"
        )
    late = raw[seen] - time[seen]
    jumps = np.abs(np.diff(late))
    if jumps.max() > max(5.0 / rate, 1.5 * grain, 0.01):
        row = int(seen[int(np.argmax(jumps)) + 1])
        text = f"{at}, {table.where(row)}: the stamps jump by {jumps.max():.4g} s against `rate: {rate:g}` of the map"
        raise UserError(f"{text}; allowed: rows without a gap, or `time: {column}` without a rate")
    return time


def coarseness(raw: Array) -> float:
    """s between different stamps, where many rows share each, or come in bursts; else 0."""
    steps = np.diff(raw)
    grain = float(np.median(steps[steps > 0])) if np.mean(steps == 0) > 0.3 and (steps > 0).any() else 0.0
    return grain or burst(raw)


def burst(raw: Array) -> float:
    """s between the bursts in which rows come, ten times as far apart as the rows in them or more; else 0."""
    steps = np.diff(raw)
    if len(steps) < WINDOW or not (steps >= 0).all() or not (steps > 0).any():
        return 0.0
    wide = steps > 0.1 * steps.max()
    apart = np.diff(np.flatnonzero(wide))
    regular = wide.sum() >= WINDOW and np.ptp(steps[wide]) < 0.5 * steps.max() and apart.min() > 1
    return float(np.median(steps[wide])) if regular and np.ptp(apart) <= 0.5 * np.median(apart) else 0.0


def roughness(time: Array, x: Array) -> float:
    """Root mean square of what parabolas through `WINDOW` rows leave of x [T] at the times [T] of one clock.

    Of two clocks for the same rows, the true one leaves less.
    """
    t, y = sliding_window_view(time, WINDOW), sliding_window_view(x, WINDOW)
    chosen = np.linspace(0, len(t) - 1, min(len(t), 4000)).astype(int)
    t, y = t[chosen], y[chosen]
    t = (t - t[:, WINDOW // 2, None]) / np.maximum(np.ptp(t, axis=1), 1e-300)[:, None]
    design = np.stack([np.ones_like(t), t, t**2], 2)
    q, _ = np.linalg.qr(design)
    left = y - (q @ (q.transpose(0, 2, 1) @ y[:, :, None]))[:, :, 0]
    return float(np.sqrt(np.mean(left**2)))


def better_clock(time: Array, rate: float, positions: Array) -> tuple[str, float]:
    """(stamps or rate, ratio of what both leave): which clock the motion in positions [T, n] fits better.

    Args:
        time: [T] s, as stamped. rate: rows per second.
    """
    grid = time[0] + np.arange(len(time)) / rate
    ratios = []
    for x in positions.T:
        by_stamps, by_rate = roughness(time, x), roughness(grid, x)
        if np.ptp(x) > 0 and min(by_stamps, by_rate) > 0:
            ratios.append(by_stamps / by_rate)
    ratio = float(np.exp(np.mean(np.log(ratios)))) if ratios else 1.0
    return ("rate", ratio) if ratio > 1 else ("stamps", 1.0 / ratio)


__all__ = ["better_clock", "check_counter", "coarseness", "even", "roughness", "seconds_of"]
