"""The columns of one file as logs: cut at long gaps, with noise and velocities known or estimated."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from bayessim_mjx.errors import UserError
from bayessim_mjx.logs.log import Array, Channels, Log, suggest
from bayessim_mjx.logs.signals import estimate_velocity, noise_level
from bayessim_mjx.logs.stamps import burst
from bayessim_mjx.logs.table import Table

MIN_ROWS = 10  # of a run between two gaps; rule of thumb, not measured
# Periods without a sample after which a file is cut in two, and across which no stream is interpolated. Rule of thumb;
# files with gaps of 4 and of 8 periods: benchmarks/records/log_checks.json
MAX_GAP = 5.0
# of a velocity that is so many times the derivative of its position
_KEYS = {"`unit: deg/s`": 180.0 / np.pi, "`unit: rpm`": 30.0 / np.pi, "`unit: rev/s`": 0.5 / np.pi, "`sign: -1`": -1.0}
SHORT_GAP = 0.01  # s; shorter pauses are bridged however fast the file is; rule of thumb, not measured


def pieces(
    table: Table,
    columns: Mapping[str, Array],
    channels: Channels,
    metadata: Mapping[str, Any],
    absent: tuple[str, ...] = (),
) -> list[Log]:
    """Return the file as one log, or as several where samples are missing for long.

    Args:
        table: the file; columns: its channels; metadata: of its logs.
        channels: the model's; absent: those that were not measured.
    """
    time = columns["time"]
    steps = np.diff(time)
    gaps = np.flatnonzero(steps > max(MAX_GAP * float(np.median(steps)), SHORT_GAP))
    edges = [0, *(gaps + 1), len(time)]
    spans = [(a, b) for a, b in zip(edges[:-1], edges[1:], strict=True) if b - a >= MIN_ROWS]
    if len(gaps):
        worst = gaps[np.argmax(steps[gaps])]
        text = (
            f"{table.path}: {len(gaps)} gap(s) in time, the largest {steps[worst]:.4g} s "
            f"after {table.where(int(worst))} (median period {np.median(steps):.4g} s)"
        )
        if not spans:
            text = f"{text}; no run of {MIN_ROWS} samples is left; allowed: gaps up to {MAX_GAP:g} periods"
            rate = (len(time) - 1) / float(time[-1] - time[0])
            key = f"`time: {{column: ..., rate: {rate:.6g}}}` in a map spaces them evenly"
            raise UserError(f"{text}; the rows come in bursts: {key}" if burst(time) else text)
        warnings.warn(f"{text}; cut into {len(spans)} run(s)", stacklevel=2)
    names = [table.path.name] if len(spans) == 1 else [f"{table.path.name}#{k}" for k in range(len(spans))]
    return [
        _log(name, {k: c[a:b] for k, c in columns.items()}, channels, metadata, absent)
        for name, (a, b) in zip(names, spans, strict=True)
    ]


def _log(
    name: str,
    columns: Mapping[str, Array],
    channels: Channels,
    metadata: Mapping[str, Any],
    absent: tuple[str, ...] = (),
) -> Log:
    rows = len(columns["time"])

    def stack(stream: str, names: Sequence[str]) -> Array:
        return np.stack([columns[f"{stream}:{n}"] for n in names], 1) if names else np.zeros((rows, 0))

    given = {k: c for k, c in columns.items() if k not in absent}
    sigma, grain = (_known(metadata, key, given, channels) for key in ("sigma", "quantum"))

    def spread_of(stream: str, names: Sequence[str], x: Array) -> Array:
        keys = [f"{stream}:{n}" for n in names]
        level = [sigma[k] if k in sigma else noise_level(c, grain.get(k)) for k, c in zip(keys, x.T, strict=True)]
        return np.array(level)

    qpos = stack("qpos", channels.qpos)
    sigma_qpos = spread_of("qpos", channels.qpos, qpos)
    velocity, spread = estimate_velocity(columns["time"], qpos, channels, sigma_qpos)
    has_qvel = all(f"qvel:{n}" in columns for n in channels.qvel)
    if has_qvel:
        measured = stack("qvel", channels.qvel)
        if absent:
            seen = np.array([f"qvel:{n}" not in absent for n in channels.qvel])
            both = seen & ~np.isin([f"qpos:{n}" for n in channels.qvel], absent)
            _compare(name, measured, np.where(both, velocity, 0.0), spread, channels)
            velocity = np.where(seen, measured, velocity)
            spread = np.where(seen, spread_of("qvel", channels.qvel, measured), spread)
        else:
            _compare(name, measured, velocity, spread, channels)
            velocity, spread = measured, spread_of("qvel", channels.qvel, measured)
    used = {"time"} | {
        f"{s}:{n}" for s in ("ctrl", "qpos", "qvel") for n in getattr(channels, s if s != "ctrl" else "actuators")
    }
    return Log(
        name=name,
        time=columns["time"],
        ctrl=stack("ctrl", channels.actuators),
        qpos=qpos,
        qvel=velocity,
        has_qvel=has_qvel,
        channels=channels,
        sigma_qpos=sigma_qpos,
        sigma_qvel=spread,
        streams={k: c for k, c in columns.items() if k not in used},
        metadata=metadata,
        absent=absent,
    )


def _known(metadata: Mapping[str, Any], key: str, columns: Mapping[str, Array], channels: Channels) -> dict[str, float]:
    """Read the declared noise or quantum per column; `<joint>` is short for `qpos:<joint>`."""
    given, source = metadata.get(key) or {}, metadata["source"]
    if not isinstance(given, Mapping):
        raise UserError(f"{source}: {key} = {given!r} in its side YAML; allowed: a mapping '<channel>: value'")
    out = {}
    for name, value in given.items():
        column = f"qpos:{name}" if name in channels.qpos else str(name)
        if column not in columns or column == "time":
            allowed = [c for c in columns if c != "time"]
            raise UserError(f"{source}: {key}.{name} in its side YAML: no such channel; {suggest(str(name), allowed)}")
        number = isinstance(value, int | float) and not isinstance(value, bool) and np.isfinite(value)
        if not number or value < 0 or (key == "sigma" and value == 0):  # 0 would make every gap an infinite one
            least = "a number > 0" if key == "sigma" else "a number >= 0"
            raise UserError(f"{source}: {key}.{name} = {value!r} in its side YAML; allowed: {least}")
        out[column] = float(value)
    return out


def _compare(name: str, measured: Array, estimated: Array, spread: Array, channels: Channels) -> None:
    """Warn where the logged velocity is not the derivative of the logged position (unit, sign)."""
    for channel, v, w, s in zip(channels.qvel, measured.T, estimated.T, spread, strict=True):
        energy = float(w @ w)
        if energy <= 9.0 * len(w) * s**2 or energy == 0.0:
            continue
        slope = float(v @ w) / energy
        if not 0.7 < slope < 1.4:
            text = f"{name}: qvel:{channel} is about {slope:.3g} times the derivative of qpos:{channel}"
            mend = next((key for key, value in _KEYS.items() if 0.97 < slope / value < 1.03), "`unit` or `scale`")
            text = f"{text}; allowed: the same unit and sign per second (mend it by {mend} in the map)"
            warnings.warn(text, stacklevel=2)
