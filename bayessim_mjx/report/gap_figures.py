"""How far: the waterfall of the squared gap, its parts over the horizons, the gap of each log, and measured against simulated."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from bayessim_mjx.report.look import (
    DASH,
    FAINT,
    HATCH,
    INK,
    STAGE,
    WIDTH,
    axis,
    broken,
    figure,
    heading,
    layout_key,
    note,
    numbers,
    panel,
    text,
)
from bayessim_mjx.report.words import STAGES, finite, label_title, number, percent, unit

# part of the squared gap: (words, stage it goes down from, stage it goes down to, stage that gives the colour)
PARTS = (
    ("recalibrated parameters", "nominal", "calibrated", "calibrated"),
    ("named effects", "calibrated", "with_effects", "with_effects"),
    ("reducible, unexplained", "with_effects", "reducible_floor", "reducible_floor"),
    ("not reproducible", "reducible_floor", "noise_floor", "noise_floor"),
)


def squares(stages: Mapping[str, Any]) -> dict[str, float]:
    """Squared gap of each stage as a share of the delivered simulator's; empty where a stage is unknown."""
    if not all(finite(stages.get(s)) for s in STAGES) or not stages["nominal"]:
        return {}
    return {s: (stages[s] / stages["nominal"]) ** 2 for s in STAGES}


def waterfall(
    stages: Mapping[str, Any], shares: Sequence[Mapping[str, Any]], ci: Mapping[str, Any] | None = None
) -> dict[str, Any] | None:
    """Bars from the delivered simulator's squared gap down to the noise; `shares` (Shapley) split the effects' part.

    Returns:
        None where a stage is unknown.
    """
    level = squares(stages)
    if not level:
        return None
    columns = [_total("as delivered", "nominal", stages, level, ci), _drop(PARTS[0], level)]
    columns += [c | {"x": _wrap(c["x"], 18)} for c in _effects(shares, level)]
    columns += [_total("with the effects" if shares else "left", "with_effects", stages, level, ci)]
    columns += [_drop(p, level) for p in PARTS[2:]]
    columns += [_total("measurement noise", "noise_floor", stages, level, ci)]
    xs = list(range(len(columns)))
    errors = [[c["error"][k] for c in columns] for k in (0, 1)]
    bars = {
        "type": "bar", "x": xs, "y": [c["height"] for c in columns], "base": [c["base"] for c in columns], "width": 0.62,
        "marker": {"color": [c["colour"] for c in columns], "line": {"color": INK, "width": 0.6},
                   "pattern": {"shape": [c["hatch"] for c in columns], "fgcolor": "white", "size": 6}},
        "error_y": {"type": "data", "symmetric": False, "arrayminus": errors[0], "array": errors[1],
                    "color": INK, "thickness": 1.2, "width": 4},
        "hovertext": [c["hover"] for c in columns], "hoverinfo": "text",
    }  # fmt: skip
    ends = [c["end"] for c in columns]
    links = [
        {"type": "line", "x0": k + 0.31, "x1": k + 0.69, "y0": e, "y1": e, "line": {"color": FAINT, "width": 1, "dash": "dot"}}
        for k, e in enumerate(ends[:-1])
    ]
    tops = [c["base"] + c["height"] + c["error"][1] for c in columns]
    marks = [
        note(c["label"], k, t, xref="x", yref="y", yanchor="bottom", yshift=3, font={"size": 13 if c["total"] else 12})
        for k, (c, t) in enumerate(zip(columns, tops, strict=True))
    ]
    return figure(
        [bars], WIDTH, 350, shapes=links, annotations=marks,
        xaxis=axis(tickvals=xs, ticktext=[c["x"] for c in columns], showgrid=False, ticks="", tickangle=0,
                   range=[-0.5, len(xs) - 0.5]),
        yaxis=axis("squared gap, share of the delivered", tickformat=".0%", range=[0, max(1.12, 1.1 * max(tops))]),
        margin={"l": 70, "r": 10, "t": 12, "b": 60},
    )  # fmt: skip


def _total(words: str, stage: str, stages: Mapping[str, Any], level: Mapping[str, float], ci: Any) -> dict[str, Any]:
    span = (ci or {}).get(stage)
    known = span is not None and all(map(finite, span))
    ends = [(s / stages["nominal"]) ** 2 for s in span] if known else [level[stage]] * 2
    between = f" ({number(span[0])} to {number(span[1])})" if known else ""
    return {
        "x": words, "base": 0.0, "height": level[stage], "end": level[stage], "total": True, "colour": STAGE[stage],
        "hatch": "", "label": f"<b>{number(stages[stage])}</b>", "hover": f"{words}: {number(stages[stage])}{between}",
        "error": (max(level[stage] - ends[0], 0.0), max(ends[1] - level[stage], 0.0)),
    }  # fmt: skip


def _drop(part: Sequence[str], level: Mapping[str, float], start: float | None = None, size: float | None = None) -> dict:
    words, above, below, stage = part
    top = level[above] if start is None else start
    end = level[below] if size is None else top - size
    label = percent(end - top, sign=True)
    return {
        "x": _wrap(words, 18), "base": min(top, end), "height": abs(top - end), "end": end, "total": False,
        "colour": STAGE[stage], "hatch": HATCH[stage], "label": label, "error": (0.0, 0.0),
        "hover": f"{words}: {label} of the delivered simulator's squared gap",
    }  # fmt: skip


def _effects(shares: Sequence[Mapping[str, Any]], level: Mapping[str, float]) -> list[dict[str, Any]]:
    """The effects' part split by their shares of it, or in one piece."""
    known = [s for s in shares if finite(s.get("share"))]
    total, whole = sum(s["share"] for s in known), level["calibrated"] - level["with_effects"]
    if not 1 <= len(known) <= 6 or total <= 0:
        return [_drop(PARTS[1], level)] if known or abs(whole) > 1e-6 else []
    out, start = [], level["calibrated"]
    for share in known:
        words = text(label_title(share["effect"], short=True), 44)
        out.append(_drop((words, *PARTS[1][1:]), level, start, whole * share["share"] / total))
        start = out[-1]["end"]
    return out


def _wrap(words: str, width: int) -> str:
    lines = [""]
    for word in words.split(" "):
        if lines[-1] and len(lines[-1]) + len(word) >= width:
            lines.append("")
        lines[-1] = f"{lines[-1]} {word}".strip()
    return "<br>".join(lines)


def horizons(rows: Sequence[Mapping[str, Any]]) -> dict[str, Any] | None:
    """Each horizon's squared gap as one bar of 100 %, cut into what closes which part."""
    known = [(str(r.get("name", "")), squares(r)) for r in rows]
    known = [(name, level) for name, level in known if level][::-1]
    if len(known) < 2:
        return None
    names = [text(name) for name, _ in known]
    parts = [*PARTS, ("measurement noise", "noise_floor", None, "noise_floor")]
    data = []
    for words, above, below, stage in parts:
        sizes = [max(level[above] - (level[below] if below else 0.0), 0.0) for _, level in known]
        hatch = "" if below is None else HATCH[stage]
        data.append({
            "type": "bar", "orientation": "h", "y": names, "x": sizes, "name": words, "width": 0.6,
            "marker": {"color": STAGE[stage], "line": {"color": "white", "width": 1},
                       "pattern": {"shape": hatch, "fgcolor": "white", "size": 6}},
            "text": [percent(s) if s > 0.045 else "" for s in sizes], "textposition": "inside", "insidetextanchor": "middle",
            "textangle": 0, "constraintext": "none",
            "textfont": {"color": "white" if stage in ("nominal", "with_effects") else INK, "size": 12},
            "hovertemplate": f"{words}: %{{x:.1%}}<extra></extra>",
        })  # fmt: skip
    return figure(
        data, WIDTH, 84 + 34 * len(known), barmode="stack", showlegend=True, margin={"l": 90, "r": 20, "t": 34, "b": 30},
        xaxis=axis(tickformat=".0%", range=[0, 1.02], showgrid=False), yaxis=axis(showgrid=False, ticks=""),
        legend={"orientation": "h", "x": 0, "y": 1.02, "yanchor": "bottom", "traceorder": "normal", "font": {"size": 12}},
    )  # fmt: skip


def episodes(rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Gap of every log at each stage, logs from top to bottom, on a logarithmic axis."""
    names = [text(r.get("log", k), 42) for k, r in enumerate(rows)]
    names = [f"{n} <span style='color:{FAINT}'>{text(r['condition'], 24)}</span>" if r.get("condition") else n
             for n, r in zip(names, rows, strict=True)]  # fmt: skip
    at = list(range(len(rows)))
    stages = ("nominal", "calibrated", "with_effects")
    values = {s: numbers([r.get(s) for r in rows]) for s in stages}
    spans = [[v for s in stages if (v := values[s][k]) is not None] for k in at]
    lines = {
        "type": "scatter", "mode": "lines", "hoverinfo": "skip", "showlegend": False, "line": {"color": "#c9cfd4", "width": 2},
        "x": [x for s in spans for x in ((min(s), max(s), None) if s else (None,))],
        "y": [y for k, s in enumerate(spans) for y in ((k, k, None) if s else (None,))],
    }  # fmt: skip
    symbols = dict(zip(stages, ("circle-open", "diamond", "circle"), strict=True))
    dots = [
        {"type": "scatter", "mode": "markers", "name": STAGES[s], "x": values[s], "y": at, "customdata": names,
         "marker": {"color": STAGE[s], "size": 10, "symbol": symbols[s], "line": {"width": 1.5, "color": STAGE[s]}},
         "hovertemplate": f"%{{customdata}}<br>{STAGES[s]}: %{{x:.3g}}<extra></extra>"}
        for s in stages
    ]  # fmt: skip
    height = 88 + 24 * max(len(rows), 2)
    return figure(
        [lines, *dots], WIDTH, height, showlegend=True, margin={"l": 120, "r": 20, "t": 30, "b": 48},
        xaxis=axis("gap in noise standard deviations (log scale)", type="log", dtick="D2" if len(rows) < 60 else 1),
        yaxis=axis(tickvals=at, ticktext=names, range=[len(rows) - 0.4, -0.6], ticks="", gridcolor="#f2f4f5"),
        legend={"orientation": "h", "x": 0, "y": 1 + 4 / height, "yanchor": "bottom", "font": {"size": 12}},
    )  # fmt: skip


def overlay(row: Mapping[str, Any], points: int = 2000) -> dict[str, Any]:
    """Measured and simulated motion of one joint above, measured minus simulated below; lines end where windows end."""
    time = np.asarray(row["time"], float)
    keep = np.arange(0, len(time), -(-len(time) // points) if len(time) else 1)
    breaks = np.searchsorted(time[keep], np.asarray(row.get("starts") or [], float) - 1e-9).tolist()
    measured = _series(row["measured"])[keep]
    stages = [s for s in ("nominal", "calibrated", "with_effects") if row.get(s) is not None]
    columns: dict[str, Any] = {"t": numbers(broken(time[keep].tolist(), breaks), 6), "m": numbers(broken(measured, breaks))}
    style = {"type": "scatter", "mode": "lines", "x": "t"}
    data = [style | {"y": "m", "name": "measured", "line": {"color": STAGE["measured"], "width": 2.4}}]
    for stage in stages:
        simulated = _series(row[stage])[keep]
        columns[stage] = numbers(broken(simulated, breaks))
        columns[f"{stage}-"] = numbers(broken(measured - simulated, breaks), 4)
        line = {"color": STAGE[stage], "width": 1.8 if stage == "with_effects" else 1.5, "dash": DASH[stage]}
        data.append(style | {"y": stage, "name": STAGES[stage], "line": line})
        lower = {"y": f"{stage}-", "name": STAGES[stage], "line": line, "yaxis": "y2", "xaxis": "x2", "showlegend": False}
        data.append(style | lower)
    for trace in data:
        trace["hovertemplate"] = "%{y:.4g}"
    in_unit = unit(str(row.get("unit", "")))
    name = text(row.get("joint", "motion"), 30)
    shape = {"color": "#d5dade", "width": 1}
    ticks = [
        {"type": "line", "x0": s, "x1": s, "y0": 0, "y1": 1, "xref": "x", "yref": "paper", "layer": "below", "line": shape}
        for s in (row.get("starts") or [])
        if finite(s)
    ]
    return figure(
        data, WIDTH, 430, showlegend=True, hovermode="x unified", shapes=ticks if len(ticks) <= 60 else [],
        xaxis=axis(domain=[0, 1], anchor="y", showticklabels=False, matches="x2"),
        xaxis2=axis("time (s)", domain=[0, 1], anchor="y2"),
        yaxis=axis(f"{name} ({in_unit})" if in_unit else name, domain=[0.42, 1]),
        yaxis2=axis(f"measured − simulated ({in_unit})" if in_unit else "measured − simulated", domain=[0, 0.34],
                    zeroline=True, zerolinecolor=FAINT),
        margin={"l": 74, "r": 12, "t": 30, "b": 46},
    ) | {"columns": columns}  # fmt: skip


def _series(values: Sequence[Any]) -> np.ndarray:
    return np.array([v if finite(v) else np.nan for v in values], float)


def commands(command: Mapping[str, Any]) -> dict[str, Any]:
    """The command of an experiment: one row per actuator, up to eight."""
    rows = list(command["ctrl"].items())[:8]
    data, layout, titles = [], {}, []
    high = 1 / len(rows)
    time = numbers(command["time"], 6)
    for k, (name, values) in enumerate(rows):
        x, y = panel(k)
        line = {"color": STAGE["with_effects"], "width": 1.6, "shape": "hv"}
        data.append({"type": "scatter", "mode": "lines", "x": time, "y": numbers(values), "xaxis": x, "yaxis": y,
                     "line": line, "hovertemplate": "%{x:.3g} s: %{y:.4g}<extra></extra>"})  # fmt: skip
        last = k == len(rows) - 1
        layout[layout_key(x)] = axis("time (s)" if last else "", anchor=y, showticklabels=last, **({} if last else {"matches": panel(len(rows) - 1)[0]}))
        layout[layout_key(y)] = axis(anchor=x, domain=[1 - (k + 1) * high + 0.05 * high, 1 - k * high - 0.2 * high], nticks=4)
        titles.append(heading(f"command to {text(name, 40)}", x, y))
    return figure(data, WIDTH, 84 + 96 * len(rows), annotations=titles, margin={"l": 60, "r": 12, "t": 8, "b": 46}, **layout)
