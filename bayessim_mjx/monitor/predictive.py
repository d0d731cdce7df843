"""Posterior predictive picture: real motion over what the simulator does under the posterior, channel by channel."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from bayessim_mjx.monitor.style import BLUE, GREEN, handles, heading, new_figure
from bayessim_mjx.monitor.tables import shorten
from bayessim_mjx.quantities import compact, percent

THIN = 0.04  # of a panel's height: twice the width of the line of the real motion; no source: a matter of style


def predictive(
    time: Any,
    real: Mapping[str, Any],
    simulated: Mapping[str, Any],
    *,
    units: Mapping[str, str] | None = None,
    before: Mapping[str, Any] | None = None,
    title: str = "real against simulated under the posterior",
    round: int | None = None,
    most: int = 8,
    lines: int = 4,
    own: str = "real",
) -> Any:
    """Real motion against the 50 and 90 % bands of simulated motion and a few single simulations.

    Where the bands would hide under the line, the median simulation is subtracted from all.

    Args:
        time: [T] seconds. real: {channel: [T] or [m, T]}. simulated: {channel: [n, T]}; NaN where an episode was over.
        units: {channel: unit}; a channel `qpos:elbow` or `qvel:elbow` is called by its quantity and joint.
        before: {channel: [n, T]} the same under the prior, drawn as a pale band.
        most: at most so many channels; of more, the worst explained ones, worst first. lines: single simulations.
        own: what the legend calls the real motion.
    Raises:
        ValueError: no channel in common, or a length that is not T.
    """
    time = np.asarray(time, float)
    data = {k: (_rows(real[k], time, k), _rows(simulated[k], time, k)) for k in real if k in simulated}
    if not data:
        raise ValueError(f"no channel in common: real has {sorted(real)}, simulated has {sorted(simulated)}")
    ranked = sorted(data, key=lambda k: -_mismatch(*data[k]))
    shown = ranked[:most] if len(ranked) > most else list(data)  # the same places in every round
    columns = 1 if len(shown) <= 3 else 2
    rows = -(-len(shown) // columns)
    figure = new_figure(9.0 if columns == 1 else 12.0, 1.1 + 2.0 * rows, layout="constrained")
    grid = figure.subplots(rows, columns, sharex=True, squeeze=False).ravel()
    for axes in grid[len(shown) :]:
        axes.remove()
    for k, (axes, name) in enumerate(zip(grid, shown, strict=False)):
        pale = None if before is None or name not in before else _rows(before[name], time, name)
        unit, (measured, others), thin = (units or {}).get(name, ""), data[name], _thin(*data[name])
        zero = _percentiles(others, [50])[0] if thin else 0.0
        _channel(axes, time, measured - zero, others - zero, None if pale is None else pale - zero, lines)
        axes.set_title(_title(name, unit, measured, others, thin), fontsize=9, loc="left")
        axes.set_ylabel(_axis(name, unit, thin), fontsize=8)
        if k >= len(shown) - columns:
            axes.set_xlabel("time [s]", fontsize=8)
            axes.tick_params(labelbottom=True)
    items = ["real", "draw", "band90", "band50"] + ["before"] * (before is not None)
    marks, texts = handles(items)
    texts = [own if item == "real" else text for item, text in zip(items, texts, strict=True)]
    figure.legend(marks, texts, loc="outside lower center", ncols=len(items), frameon=False, fontsize=8)
    few = f", {len(shown)} of {len(ranked)} channels, worst explained first" if len(ranked) > most else ""
    figure.suptitle(heading(title, round) + few, fontsize=11)
    return figure


def _rows(values: Any, time: np.ndarray, name: str) -> np.ndarray:
    rows = np.atleast_2d(np.asarray(values, float))
    if rows.shape[-1] != len(time):
        raise ValueError(f"channel {name!r} has {rows.shape[-1]} steps, but time has {len(time)}")
    return rows


def _mismatch(real: np.ndarray, simulated: np.ndarray) -> float:
    """Root mean square of real - median simulation, in units of how much the channel moves at all."""
    off = real - _percentiles(simulated, [50])[0]
    both = np.concatenate([real.ravel(), simulated.ravel()])
    moves = both[np.isfinite(both)].std() if np.isfinite(both).any() else 0.0
    known = off[np.isfinite(off)]
    return float(np.sqrt((known**2).mean()) / moves) if len(known) and moves > 1e-9 else -1.0


def _thin(real: np.ndarray, simulated: np.ndarray) -> bool:
    """Whether the 90 % band is too narrow to be seen beside the whole motion."""
    low, high = _percentiles(simulated, [5, 95])
    seen = np.concatenate([real.ravel(), low, high])
    known = np.isfinite(low) & np.isfinite(real).any(0)
    return bool(known.any()) and float(np.median((high - low)[known])) < THIN * float(np.ptp(seen[np.isfinite(seen)]))


def _percentiles(rows: np.ndarray, percent: Sequence[float]) -> np.ndarray:
    """Percentiles over the rows [n, T] -> [q, T]; NaN where no row is left."""
    out = np.full((len(percent), rows.shape[1]), np.nan)
    alive = np.isfinite(rows).any(0)
    if alive.any():
        out[:, alive] = np.nanpercentile(rows[:, alive], percent, axis=0)
    return out


def _channel(axes: Any, time: np.ndarray, real: np.ndarray, simulated: np.ndarray, pale: Any, lines: int) -> None:
    if pale is not None:
        axes.fill_between(time, *_percentiles(pale, [5, 95]), color=GREEN, alpha=0.13, lw=0)
    band = _percentiles(simulated, [5, 25, 75, 95])
    axes.fill_between(time, band[0], band[3], color=BLUE, alpha=0.18, lw=0)
    axes.fill_between(time, band[1], band[2], color=BLUE, alpha=0.32, lw=0)
    for row in simulated[:: max(1, len(simulated) // max(lines, 1))][:lines]:
        axes.plot(time, row, color=BLUE, lw=0.6, alpha=0.8)
    for row in real:
        axes.plot(time, row, color="black", lw=1.5)
    axes.grid(color="#EAEAEA", lw=0.6)
    axes.set_axisbelow(True)
    axes.margins(x=0)
    seen = np.concatenate([real.ravel(), band.ravel()])
    seen = seen[np.isfinite(seen)]
    if len(seen) and (wide := float(np.ptp(seen))) > 0:  # one simulation that runs away must not flatten the rest
        axes.set_ylim(seen.min() - 0.08 * wide, seen.max() + 0.08 * wide)
    axes.tick_params(labelsize=7.5)
    axes.spines[["top", "right"]].set_visible(False)


def quantity(channel: str, unit: str) -> tuple[str, str]:
    """Split `qvel:elbow` in rad/s into (what is measured, joint): ("angular velocity", "elbow"); "" if not known."""
    stream, _, joint = channel.partition(":")
    known = {"qpos": {"rad": "angle", "m": "position", "": "orientation"}, "qvel": {"rad/s": "angular velocity"}}
    if not joint or stream not in known:
        return "", channel
    return known[stream].get(unit, "velocity" if stream == "qvel" else "position"), joint


def _axis(channel: str, unit: str, thin: bool) -> str:
    what, joint = quantity(channel, unit)
    short = shorten([joint], 22)[0]
    if thin:  # the panel's title names quantity and joint
        return "minus median" + f" [{unit}]" * bool(unit)
    return f"{what} of\n{short}" * bool(what) + f" [{unit}]" * bool(unit)


def _title(channel: str, unit: str, real: np.ndarray, simulated: np.ndarray, thin: bool) -> str:
    what, joint = quantity(channel, unit)
    name = f"{shorten([joint], 40)[0]}, {what}" if what else shorten([channel], 40)[0]
    low, high = _percentiles(simulated, [5, 95])
    known = np.isfinite(real) & np.isfinite(low)
    if not known.any():
        return name
    inside = ((real >= low) & (real <= high))[known].mean()
    moves = f"; moves by {compact(np.nanmax(real) - np.nanmin(real), 2)} {unit}".rstrip() if thin else ""
    return f"{name}   ({percent(inside)} inside the 90 % band{moves})"
