"""Stamps that jitter, against rows at an even rate: which of the two the recorded motion fits better."""

from __future__ import annotations

import dataclasses
import warnings
from collections.abc import Mapping

import numpy as np

from bayessim_mjx.logs.log import Array, Channels
from bayessim_mjx.logs.mapping import LogMap
from bayessim_mjx.logs.stamps import WINDOW, better_clock, coarseness
from bayessim_mjx.logs.table import Table

# benchmarks/records/log_checks.json
SURE = 1.2  # ratio of the residuals of both clocks, from which one is named
UNEVEN = 0.1  # share of the steps that are off by more than a fifth; records/log_checks.json


def say_better_clock(table: Table, columns: Mapping[str, Array], channels: Channels, log_map: LogMap) -> None:
    """Warns where the motion fits a clock better than the one that is used: stamps, or an even rate."""
    time = columns["time"]
    kinds = zip(channels.joints, channels.kinds, strict=True)
    moved = [columns[f"qpos:{j}"] for j, kind in kinds if kind in ("hinge", "slide")]
    if len(time) < 4 * WINDOW or not moved:
        return
    positions = np.stack(moved, 1)
    stated = log_map.time.rate
    if stated is not None:
        _against_stated(table, time, positions, log_map, stated)
        return
    steps = np.diff(time)
    if np.mean(np.abs(steps / np.median(steps) - 1.0) > 0.2) <= UNEVEN or steps.max() > 5.0 * np.median(steps):
        return
    rate = (len(time) - 1) / float(time[-1] - time[0])
    better, ratio = better_clock(time, rate, positions)
    if better == "rate" and ratio > SURE:
        text = f"{table.path}: the motion fits an even rate of {rate:.6g} rows per second better than the stamps"
        key = f"`time: {{column: ..., rate: {rate:.6g}}}` in a map takes it"
        warnings.warn(f"{text} (the residual of the stamps is {ratio:.2g} times as large); {key}", stacklevel=3)


def _against_stated(table: Table, time: Array, positions: Array, log_map: LogMap, rate: float) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # said when the table was read
        raw = dataclasses.replace(log_map.time, rate=None).read(table, "time")
    if len(raw) != len(time) or coarseness(raw) or not (np.diff(raw) > 0).all():
        return
    late = raw - time
    better, ratio = better_clock(raw, rate, positions)
    text = f"{table.path}: stamps are up to {1e3 * float(np.ptp(late)):.3g} ms apart from `rate: {rate:g}` of the map"
    if ratio < SURE:
        verdict = "the motion fits both about as well; the rate is used"
    elif better == "rate":
        verdict = (
            f"the motion fits the rate better (the residual of the stamps is {ratio:.2g} times as large); it is used"
        )
    else:
        verdict = f"the motion fits the stamps better (the residual of the rate is {ratio:.2g} times as large)"
        verdict += ": leave the rate out"
    if np.ptp(late) > 0.2 / rate:
        warnings.warn(f"{text}; {verdict}", stacklevel=4)


__all__ = ["say_better_clock"]
