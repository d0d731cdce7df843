"""Measured against simulated motion, the gap of every log, and the commands of an experiment."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from bayessim_mjx.quantities import finite, unit
from bayessim_mjx.report.look import (
    DASH,
    FAINT,
    NARROW,
    STAGE,
    WIDTH,
    axis,
    broken,
    figure,
    heading,
    layout_key,
    log_axis,
    numbers,
    panel,
    text,
)
from bayessim_mjx.report.words import STAGES


def _condition(row: Mapping[str, Any]) -> str:
    """Return the log's operating condition, where that is not the log itself."""
    condition = row.get("condition")
    known = condition and condition != row.get("log")
    return f" <span style='color:{FAINT}'>{text(condition, 24)}</span>" if known else ""


def episodes(rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Gap of every log at each stage, logs from top to bottom, on a logarithmic axis."""
    names = [text(r.get("log", k), 42) for k, r in enumerate(rows)]
    names = [n + _condition(r) for n, r in zip(names, rows, strict=True)]
    at = list(range(len(rows)))
    stages = [s for s in ("nominal", "calibrated", "with_effects") if any(finite(r.get(s)) for r in rows)]
    values = {s: numbers([r.get(s) for r in rows]) for s in stages}
    spans = [[v for s in stages if (v := values[s][k]) is not None] for k in at]
    lines = {
        "type": "scatter",
        "mode": "lines",
        "hoverinfo": "skip",
        "showlegend": False,
        "line": {"color": "#c9cfd4", "width": 2},
        "x": [x for s in spans for x in ((min(s), max(s), None) if s else (None,))],
        "y": [y for k, s in enumerate(spans) for y in ((k, k, None) if s else (None,))],
    }
    symbols = {"nominal": "circle-open", "calibrated": "diamond", "with_effects": "circle"}
    dots = [
        {
            "type": "scatter",
            "mode": "markers",
            "name": STAGES[s],
            "x": values[s],
            "y": at,
            "customdata": names,
            "marker": {"color": STAGE[s], "size": 10, "symbol": symbols[s], "line": {"width": 1.5, "color": STAGE[s]}},
            "hovertemplate": f"%{{customdata}}<br>{STAGES[s]}: %{{x:.3g}}<extra></extra>",
        }
        for s in stages
    ]
    height = 88 + 24 * max(len(rows), 2)
    return figure(
        [lines, *dots],
        WIDTH,
        height,
        least=NARROW,
        showlegend=True,
        margin={"l": 120, "r": 20, "t": 30, "b": 48},
        xaxis=log_axis("gap (noise sd, log scale)", [v for s in stages for v in values[s]]),
        yaxis=axis(tickvals=at, ticktext=names, range=[len(rows) - 0.4, -0.6], ticks="", gridcolor="#f2f4f5"),
        legend={"orientation": "h", "x": 0, "y": 1 + 4 / height, "yanchor": "bottom", "font": {"size": 12}},
    )


def overlay(row: Mapping[str, Any], points: int = 2000) -> dict[str, Any]:
    """Measured and simulated motion of one joint above, measured minus simulated below; lines end where windows end."""
    time = np.asarray(row["time"], float)
    keep = np.arange(0, len(time), -(-len(time) // points) if len(time) else 1)
    breaks = np.searchsorted(time[keep], np.asarray(row.get("starts") or [], float) - 1e-9).tolist()
    measured = _series(row["measured"])[keep]
    stages = [s for s in ("nominal", "calibrated", "with_effects") if row.get(s) is not None]
    columns: dict[str, Any] = {
        "t": numbers(broken(time[keep].tolist(), breaks), 6),
        "m": numbers(broken(measured, breaks)),
    }
    for stage in stages:
        simulated = _series(row[stage])[keep]
        columns[stage] = numbers(broken(simulated, breaks))
        columns[f"{stage}-"] = numbers(broken(measured - simulated, breaks), 4)
    tail = f" ({unit(str(row['unit']))})" if row.get("unit") else ""
    name = text(row.get("joint", "motion"), 30)
    ticks = _starts(row)
    return figure(
        _lines(stages),
        WIDTH,
        470,
        least=NARROW,
        showlegend=True,
        hovermode="x unified",
        shapes=ticks if len(ticks) <= 60 else [],
        xaxis=axis(domain=[0, 1], anchor="y", showticklabels=False, ticks="", matches="x2"),
        xaxis2=axis("time (s)", domain=[0, 1], anchor="y2"),
        yaxis=axis(domain=[0.44, 1]),
        yaxis2=axis(domain=[0, 0.34], zeroline=True, zerolinecolor=FAINT, nticks=6),
        annotations=[heading(name + tail, "x", "y"), heading("measured − simulated" + tail, "x2", "y2")],
        legend={"orientation": "h", "x": 0, "y": -0.14, "yanchor": "top", "font": {"size": 12}},
        margin={"l": 56, "r": 12, "t": 30, "b": 76},
    ) | {"columns": columns}


def _lines(stages: Sequence[str]) -> list[dict[str, Any]]:
    """Traces of measured and simulated motion above, and of their difference below."""
    style = {"type": "scatter", "mode": "lines", "x": "t", "hovertemplate": "%{y:.4g}"}
    data = [style | {"y": "m", "name": "measured", "opacity": 0.3, "line": {"color": STAGE["measured"], "width": 5}}]
    for stage in stages:
        line = {"color": STAGE[stage], "width": 1.8 if stage == "with_effects" else 1.5, "dash": DASH[stage]}
        data.append(style | {"y": stage, "name": STAGES[stage], "line": line})
        lower = {"xaxis": "x2", "yaxis": "y2", "showlegend": False}
        data.append(style | {"y": f"{stage}-", "name": STAGES[stage], "line": line} | lower)
    return data


def _starts(row: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Draw a thin line at the start of each window."""
    line = {"color": "#d5dade", "width": 1}
    style = {"type": "line", "y0": 0, "y1": 1, "xref": "x", "yref": "paper", "layer": "below", "line": line}
    return [style | {"x0": s, "x1": s} for s in (row.get("starts") or []) if finite(s)]


def _series(values: Sequence[Any]) -> np.ndarray:
    return np.array([v if finite(v) else np.nan for v in values], float)


def commands(command: Mapping[str, Any]) -> dict[str, Any]:
    """Draw the command of an experiment: one row per actuator, up to eight."""
    rows = list(command["ctrl"].items())[:8]
    data, titles = [], []
    layout: dict[str, Any] = {}
    high = 1 / len(rows)
    time = numbers(command["time"], 6)
    for k, (name, values) in enumerate(rows):
        x, y = panel(k)
        line = {"color": STAGE["with_effects"], "width": 1.6, "shape": "hv"}
        data.append(
            {
                "type": "scatter",
                "mode": "lines",
                "x": time,
                "y": numbers(values),
                "xaxis": x,
                "yaxis": y,
                "line": line,
                "hovertemplate": "%{x:.3g} s: %{y:.4g}<extra></extra>",
            }
        )
        last = panel(len(rows) - 1)[0]
        across = {"title": "time (s)"} if x == last else {"matches": last}
        layout[layout_key(x)] = axis(anchor=y, showticklabels=x == last, **across)
        layout[layout_key(y)] = axis(anchor=x, domain=[1 - (k + 0.95) * high, 1 - (k + 0.2) * high], nticks=4)
        titles.append(heading(f"command to {text(name, 40)}", x, y))
    margin = {"l": 60, "r": 12, "t": 8, "b": 46}
    return figure(data, WIDTH, 84 + 96 * len(rows), least=NARROW, annotations=titles, margin=margin, **layout)
