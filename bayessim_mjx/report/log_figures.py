"""Figures of logs: channels over time, spectra, coverage, what excites what, periods of the rows."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from bayessim_mjx.logs.channel_units import RATES
from bayessim_mjx.logs.excited import Excitation
from bayessim_mjx.logs.views import Coverage, Sheet, spectrum, thinned, velocity
from bayessim_mjx.monitor.style import BLUE
from bayessim_mjx.report.look import (
    COLUMN,
    INK,
    WIDTH,
    axis,
    figure,
    heading,
    layout_key,
    log_axis,
    note,
    numbers,
    panel,
    text,
)

COLOURS = {"ctrl": "#D55E00", "qpos": BLUE, "qvel": "#009E73", "effort": "#CC79A7", "": "#5b6670"}
TITLES = {"ctrl": "command", "qpos": "position", "qvel": "velocity", "effort": "effort"}
ROW = 104  # px, of a panel over time
PHONE = 340  # px, width at which figures without small text can still be read
DARK = 0.45  # coherence from which on the colour is dark behind a number
SCALE = [[0, "#ffffff"], [0.02, "#dbe9f4"], [0.3, "#6aaed6"], [1, "#08306b"]]


def over_time(sheet: Sheet, channels: Sequence[str], most: int, units: Mapping[str, str]) -> dict[str, Any]:
    """One panel for each channel, above each other; `most`: points of a line; units: {channel: unit}."""
    data: list[dict[str, Any]] = []
    layout: dict[str, Any] = {}
    titles = []
    high = 1 / max(len(channels), 1)
    for k, channel in enumerate(channels):
        x, y = panel(k)
        stream, _, name = channel.partition(":")
        kind = stream if name else ""
        estimated = channel not in sheet.channels
        values = velocity(sheet, name) if estimated else sheet.channels[channel]
        time, shown = thinned(sheet.time, np.asarray(values, float), most)
        line = {"color": COLOURS.get(kind, COLOURS[""]), "width": 1.3} | ({"shape": "hv"} if kind == "ctrl" else {})
        hover = "%{x:.4g} s: %{y:.4g}<extra></extra>"
        data.append(
            {
                "type": "scatter",
                "mode": "lines",
                "x": numbers(time, 6),
                "y": numbers(shown),
                "xaxis": x,
                "yaxis": y,
                "line": line,
                "hovertemplate": hover,
            }
        )
        last = panel(len(channels) - 1)[0]
        across = {"title": "time (s)"} if x == last else {"matches": last}
        layout[layout_key(x)] = axis(anchor=y, showticklabels=x == last, **across)
        layout[layout_key(y)] = axis(anchor=x, domain=[1 - (k + 0.95) * high, 1 - (k + 0.26) * high], nticks=4)
        said = f"{TITLES[kind]} {name}" if kind in TITLES else channel
        said += f" ({units[channel]})" if channel in units else ""
        titles.append(heading(text(said + (", estimated" if estimated else ""), 60), x, y))
    margin = {"l": 54, "r": 10, "t": 6, "b": 46}
    return figure(data, WIDTH, 60 + ROW * len(channels), least=PHONE, annotations=titles, margin=margin, **layout)


def spectra(sheets: Sequence[Sheet], channels: Sequence[str], units: Mapping[str, str]) -> dict[str, Any] | None:
    """Amplitude densities of the channels of one joint; units: {channel: unit}."""
    data, every, across = [], [], []
    for channel in channels:
        found = spectrum(sheets, channel)
        if found is None or not np.isfinite(found[1]).any() or np.nanmax(found[1]) <= 0:
            continue
        stream, _, name = channel.partition(":")
        every += [v for v in found[1].tolist() if v > 0]
        across += found[0].tolist()
        label = f"{TITLES[stream]} {name}" if stream in TITLES else channel
        label += f" ({units[channel]})" if channel in units else ""
        data.append(
            {
                "type": "scatter",
                "mode": "lines",
                "x": _digits(found[0]),
                "y": _digits(found[1]),
                "name": text(label, 40),
                "line": {"color": COLOURS.get(stream, COLOURS[""]), "width": 1.6},
                "hovertemplate": "%{x:.3g} Hz: %{y:.3g}<extra></extra>",
            }
        )
    if not data:
        return None
    low = max(every) * 1e-6
    limits = [float(np.log10(max(min(every), low))) - 0.1, float(np.log10(max(every))) + 0.2]
    ticks = [10.0**p for p in range(int(np.ceil(limits[0])), int(np.floor(limits[1])) + 1)]
    shown = {"type": "log", "range": limits, "tickvals": ticks, "ticktext": [f"{t:g}" for t in ticks]}
    margin = {"l": 64, "r": 12, "t": 34, "b": 50}
    return figure(
        data,
        WIDTH,
        330,
        least=PHONE,
        showlegend=True,
        xaxis=log_axis("frequency (Hz)", across),
        yaxis=axis("density (unit / √Hz)", **shown),
        margin=margin,
    )


def _digits(values: np.ndarray) -> list[float | None]:
    """Four digits of each number, for logarithmic axes."""
    return [float(f"{v:.4g}") if np.isfinite(v) and v > 0 else None for v in values.tolist()]


def covered(
    joint: str, found: Coverage, limits: tuple[float, float] | None, high: int, unit: str = ""
) -> dict[str, Any]:
    """Rows by position and velocity, dark where there are many; dashed: the ends of the model's range."""
    of_place, of_speed = (f" ({unit})", f" ({RATES[unit]})") if unit else ("", "")
    counts = np.where(found.counts > 0, np.sqrt(found.counts), np.nan)
    middle = [0.5 * (edges[1:] + edges[:-1]) for edges in (found.places, found.speeds)]
    values = [[None if np.isnan(v) else round(float(v), 2) for v in row] for row in counts]
    data = [
        {
            "type": "heatmap",
            "x": numbers(middle[0]),
            "y": numbers(middle[1]),
            "z": values,
            "colorscale": [[0, SCALE[1][1]], *SCALE[2:]],
            "showscale": False,
            "hovertemplate": "%{x:.3g}, %{y:.3g}<extra></extra>",
        }
    ]
    ends = [x for x in limits or () if np.isfinite(x)]
    shapes = [
        {
            "type": "line",
            "x0": x,
            "x1": x,
            "y0": 0,
            "y1": 1,
            "yref": "paper",
            "line": {"color": "#D55E00", "dash": "dash", "width": 1.4},
        }
        for x in ends
    ]
    margin = {"l": 60, "r": 12, "t": 30, "b": 48}
    shape = {
        "xaxis": axis(f"position{of_place}", nticks=6),
        "yaxis": axis(f"velocity{of_speed}", nticks=6),
        "shapes": shapes,
        "margin": margin,
    }
    return figure(data, COLUMN, high, least=PHONE, annotations=[heading(text(joint, 40), "x", "y")], **shape)


def excited(found: Excitation) -> dict[str, Any]:
    """Coherence of commands (rows) with joints (columns)."""
    small = len(found.joints) <= 12
    marks = [
        note(f"{v:.2f}", j, i, xref="x", yref="y", font={"size": 11, "color": "white" if v > DARK else INK})
        for (i, j), v in np.ndenumerate(found.coherence)
        if small and np.isfinite(v)
    ]
    values = [[None if not np.isfinite(v) else round(float(v), 3) for v in row] for row in found.coherence]
    data = [
        {
            "type": "heatmap",
            "z": values,
            "colorscale": SCALE,
            "zmin": 0,
            "zmax": 1,
            "xgap": 1,
            "ygap": 1,
            "showscale": False,
            "hovertemplate": "%{y} → %{x}: %{z:.2f}<extra></extra>",
        }
    ]
    names = {axis_name: [text(n, 24) for n in own] for axis_name, own in (("x", found.joints), ("y", found.commands))}
    ticks = {k: {"tickvals": list(range(len(v))), "ticktext": v, "showgrid": False} for k, v in names.items()}
    wide = min(WIDTH, 150 + 74 * len(found.joints)) if small else WIDTH
    layout = {
        "xaxis": axis("joint", **ticks["x"], side="bottom", tickangle=-40 if len(found.joints) > 3 else 0),
        "yaxis": axis("command", **ticks["y"], autorange="reversed"),
        "margin": {"l": 90, "r": 12, "t": 10, "b": 70},
    }
    return figure(
        data,
        wide,
        110 + 30 * len(found.commands),
        least=min(wide, PHONE + 24 * len(found.joints)),
        annotations=marks,
        **layout,
    )


def periods(sheets: Sequence[Sheet], most: int) -> dict[str, Any]:
    """Time from row to row of every log, over the time since its start."""
    data, each = [], max(most // max(len(sheets), 1), 40)
    for sheet in sheets:
        time, steps = thinned(sheet.time[1:] - sheet.time[0], 1e3 * np.diff(sheet.time), each)
        data.append(
            {
                "type": "scatter",
                "mode": "lines",
                "x": numbers(time),
                "y": numbers(steps),
                "name": text(sheet.name, 30),
                "line": {"width": 1.1, "color": BLUE if len(sheets) == 1 else None},
                "hovertemplate": f"{text(sheet.name, 30)}, %{{x:.4g}} s: %{{y:.4g}} ms<extra></extra>",
            }
        )
    largest = max(float(np.diff(s.time).max()) for s in sheets) * 1e3
    layout = {
        "xaxis": axis("time since the start of the log (s)"),
        "yaxis": axis("row to row (ms)", range=[0, 1.15 * largest]),
    }
    legend = 1 < len(sheets) <= 6
    margin = {"l": 60, "r": 12, "t": 44 if legend else 14, "b": 50}
    return figure(
        data, WIDTH, 260, least=PHONE, showlegend=legend, margin=margin, font={"color": INK, "size": 12}, **layout
    )


__all__ = ["covered", "excited", "over_time", "periods", "spectra"]
