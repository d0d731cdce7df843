"""Where and which: forces over regions of the state, frequency responses, estimates per condition, isolability, the residual."""

from collections.abc import Mapping, Sequence
from typing import Any

from bayessim_mjx.monitor.style import BLUE, SKY
from bayessim_mjx.report.look import (
    DASH,
    FAINT,
    INK,
    STAGE,
    WIDTH,
    axis,
    cells,
    figure,
    heading,
    layout_key,
    note,
    numbers,
    panel,
    text,
)
from bayessim_mjx.report.words import finite, label_title, percent, unit

MAPS_PER_ROW = 3
MOST_LABELS = 36


def maps(rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Disturbance force on one joint over what it may depend on: mean and interval per bin, filled where significant."""
    columns = min(MAPS_PER_ROW, len(rows))
    lines = -(-len(rows) // columns)
    height = 66 + 190 * lines
    places = cells(len(rows), columns, 0.055, 82 / height)
    data, layout, titles = [], {}, []
    for k, (row, (across, up)) in enumerate(zip(rows, places, strict=True)):
        x, y = panel(k)
        data += _map(row, x, y)
        more = {"domain": across, "anchor": y, "showgrid": False, "nticks": 6}
        if row.get("axis") == "direction" and len(row["mean"]) == 2:
            more |= {"tickvals": _centres(row), "ticktext": ["backward", "forward"], "range": [row["edges"][0], row["edges"][-1]]}
        in_unit = f" ({unit(row['unit'])})" if row.get("unit") else ""
        layout[layout_key(x)] = axis(text(row.get("axis", ""), 40) + in_unit, **more)
        share = {"matches": "y"} if k else {}
        first = k % columns == 0
        force = f"force ({unit(row.get('force_unit', ''))})" if first else ""
        zero = {"zeroline": True, "zerolinecolor": FAINT, "zerolinewidth": 1}
        layout[layout_key(y)] = axis(force, domain=up, anchor=x, nticks=6, showticklabels=first, **zero, **share)
        titles.append(heading(f"over {text(row.get('axis', ''), 40)}", x, y))
    return figure(data, WIDTH if columns == 3 else 320 * columns, height, annotations=titles,
                  margin={"l": 66, "r": 10, "t": 26, "b": 50}, **layout)  # fmt: skip


def _centres(row: Mapping[str, Any]) -> list[float]:
    return [(a + b) / 2 for a, b in zip(row["edges"], row["edges"][1:], strict=False)]


def _map(row: Mapping[str, Any], x: str, y: str) -> list[dict[str, Any]]:
    centres, mean = _centres(row), numbers(row["mean"])
    low, high = numbers(row.get("low", row["mean"])), numbers(row.get("high", row["mean"]))
    strong = [bool(s) for s in row.get("significant") or [True] * len(mean)]
    counts = row.get("count") or [""] * len(mean)
    out = []
    for kind in (False, True):
        pick = [k for k, s in enumerate(strong) if s is kind and mean[k] is not None]
        if not pick:
            continue
        colour = BLUE if kind else "#9aa3ab"
        mark = {"color": colour if kind else "white", "size": 8, "line": {"color": colour, "width": 1.6}}
        out.append({
            "type": "scatter", "mode": "markers", "xaxis": x, "yaxis": y, "marker": mark, "x": [centres[k] for k in pick],
            "y": [mean[k] for k in pick], "customdata": [counts[k] for k in pick],
            "error_y": {"type": "data", "symmetric": False, "color": colour, "thickness": 1.6, "width": 0,
                        "array": [_reach(high[k], mean[k]) for k in pick],
                        "arrayminus": [_reach(mean[k], low[k]) for k in pick]},
            "hovertemplate": "%{x:.3g}: %{y:.3g} (%{customdata} samples)<extra></extra>",
        })  # fmt: skip
    path = {"type": "scatter", "mode": "lines", "xaxis": x, "yaxis": y, "x": centres, "y": mean, "hoverinfo": "skip",
            "line": {"color": "#c9cfd4", "width": 1.2}}  # fmt: skip
    return [path, *out]


def _reach(upper: float | None, lower: float | None) -> float:
    return max(upper - lower, 0.0) if upper is not None and lower is not None else 0.0


def frequency(row: Mapping[str, Any]) -> dict[str, Any]:
    """Gain, phase and coherence from command to motion, measured and simulated; amplitudes by order where there are any."""
    wanted = [("gain", "gain", "", {"type": "log"}), ("phase", "phase (deg)", "_deg", {}),
              ("coherence", "coherence", "", {"range": [0, 1.04]})]  # fmt: skip
    panels = [w for w in wanted if row.get(f"{w[0]}_real{w[2]}") is not None]
    orders = row.get("orders") or []
    count = len(panels) + bool(orders)
    data, layout, titles = [], {}, []
    for k, (across, _) in enumerate(cells(count, count, 0.075, 0)):
        x, y = panel(k)
        if k < len(panels):
            key, words, tail, more = panels[k]
            for who, style in (("real", "measured"), ("sim", "calibrated")):
                if row.get(f"{key}_{who}{tail}") is None:
                    continue
                line = {"color": STAGE[style], "width": 1.8, "dash": DASH[style]}
                data.append({"type": "scatter", "mode": "lines", "x": numbers(row["hz"]), "y": numbers(row[f"{key}_{who}{tail}"]),
                             "xaxis": x, "yaxis": y, "line": line, "showlegend": k == 0,
                             "name": "measured" if who == "real" else "recalibrated simulation",
                             "hovertemplate": "%{x:.3g} Hz: %{y:.3g}<extra></extra>"})  # fmt: skip
            layout[layout_key(x)] = axis("frequency (Hz)", type="log", domain=across, anchor=y, dtick="D2", minor={"ticks": ""})
            layout[layout_key(y)] = axis(anchor=x, nticks=6, **more)
        else:
            words = "residual by order"
            data.append({"type": "bar", "x": [o.get("order") for o in orders], "y": numbers([o.get("amplitude") for o in orders]),
                         "xaxis": x, "yaxis": y, "marker": {"color": BLUE}, "showlegend": False,
                         "hovertemplate": "order %{x}: %{y:.3g}<extra></extra>"})  # fmt: skip
            layout[layout_key(x)] = axis("cycles per revolution", domain=across, anchor=y, showgrid=False)
            layout[layout_key(y)] = axis(anchor=x, nticks=6)
        titles.append(heading(words, x, y))
    legend = {"orientation": "h", "x": 0, "y": 1.13, "yanchor": "bottom", "font": {"size": 12}}
    return figure(data, WIDTH, 290, showlegend=bool(panels), annotations=titles, legend=legend,
                  margin={"l": 50, "r": 12, "t": 62, "b": 48}, **layout)  # fmt: skip


def groups(names: Sequence[str], parameters: Mapping[str, Mapping[str, Any]], known: Mapping[str, Any]) -> dict[str, Any]:
    """Estimates of each parameter per operating condition (mean and 2 sd); the dotted line is the simulator's own value."""
    shown = list(parameters.items())[:12]
    columns = min(3, len(shown))
    longest = max((len(str(n)) for n in names), default=1)
    foot = 34 if longest * len(names) < 34 else min(7 * longest, 80) + 16
    height = 40 + (140 + foot) * -(-len(shown) // columns)
    data, layout, titles = [], {}, []
    for k, ((name, row), (across, up)) in enumerate(zip(shown, cells(len(shown), columns, 0.07, (36 + foot) / height), strict=True)):
        x, y = panel(k)
        moves = bool(known.get(name, {}).get("structural"))
        colour = STAGE["nominal"] if moves else STAGE["with_effects"]
        spread = [2 * s if finite(s) else 0 for s in row.get("sd") or [0.0] * len(names)]
        data.append({"type": "scatter", "mode": "markers", "x": list(range(len(names))), "y": numbers(row["mean"]), "xaxis": x,
                     "yaxis": y, "marker": {"color": colour, "size": 8, "symbol": "diamond" if moves else "circle"},
                     "error_y": {"type": "data", "array": spread, "color": colour, "thickness": 1.6, "width": 0},
                     "hovertemplate": "%{y:.4g}<extra></extra>"})  # fmt: skip
        ticks = {"tickvals": list(range(len(names))), "ticktext": [text(n, 16) for n in names], "showgrid": False}
        layout[layout_key(x)] = axis(domain=across, anchor=y, range=[-0.6, len(names) - 0.4], **ticks)
        layout[layout_key(y)] = axis(unit(str(known.get(name, {}).get("unit", ""))), domain=up, anchor=x, nticks=5)
        titles.append(heading(text(name, 34) + (" (moves)" if moves else ""), x, y))
        layout.setdefault("shapes", []).extend(_level(known.get(name, {}).get("nominal"), x, y))
    return figure(data, WIDTH if columns == 3 else 320 * columns, height, annotations=titles,
                  margin={"l": 60, "r": 10, "t": 28, "b": 12 + foot}, **layout)  # fmt: skip


def _level(value: Any, x: str, y: str) -> list[dict[str, Any]]:
    line = {"color": FAINT, "width": 1.2, "dash": "dot"}
    place = {"type": "line", "xref": f"{x} domain", "x0": 0, "x1": 1, "yref": y, "y0": value, "y1": value}
    return [place | {"line": line}] if finite(value) else []


def isolability(labels: Sequence[str], cosine: Sequence[Sequence[float]], absorbed: Sequence[float]) -> dict[str, Any]:
    """|cos| between what effects do to these logs (lower triangle), and the share that the known parameters would hide."""
    n = min(len(labels), MOST_LABELS)
    names = [text(label_title(label, short=True), 46) for label in labels[:n]]
    table = [[numbers([cosine[i][j]])[0] if j <= i else None for j in range(n)] for i in range(n)]
    hide = [absorbed[i] if i < len(absorbed) and finite(absorbed[i]) else None for i in range(n)]
    cell = 30 if n <= 18 else 20
    at = list(range(n))
    heat = {
        "type": "heatmap", "z": table, "x": at, "y": at, "zmin": 0, "zmax": 1, "xgap": 1, "ygap": 1, "hoverongaps": False,
        "colorscale": [[0, "#f7fafc"], [0.5, SKY], [1, "#00507d"]], "showscale": False,
        "customdata": [[f"{names[i]}<br>and {names[j]}" for j in range(n)] for i in range(n)],
        "hovertemplate": "%{customdata}<br>|cos| = %{z:.2f}<extra></extra>",
    }  # fmt: skip
    values = [
        note(f"{v:.2f}".replace("0.", ".") if v < 0.995 else "1", j, i, xref="x", yref="y",
             font={"size": 11 if cell == 30 else 8.5, "color": "white" if v > 0.72 else INK})
        for i, row in enumerate(table) for j, v in enumerate(row) if v is not None and j < i and v >= 0.3
    ]  # fmt: skip
    bars = {
        "type": "bar", "orientation": "h", "x": hide, "y": at, "xaxis": "x2", "yaxis": "y", "width": 0.62,
        "marker": {"color": "#E69F00", "line": {"color": INK, "width": 0.5}}, "text": [percent(h) for h in hide],
        "textposition": "outside", "cliponaxis": False, "hoverinfo": "skip", "textfont": {"size": 11},
    }  # fmt: skip
    left = 8 + 6.6 * max(map(len, names), default=10)
    foot = 0.72 * left + 14
    side = cell * n
    width = WIDTH if left + side + 170 > 700 else round(left + side + 250)
    split = (side / (width - left - 60), (side + 30) / (width - left - 60))
    split = split if split[1] < 0.85 else (0.78, 0.82)
    over = [heading("similarity |cos|", "x", "y"), heading("hidden by known parameters", "x2", "y")]
    return figure(
        [heat, bars], width, round(side + 34 + foot), annotations=[*over, *values],
        xaxis=axis(domain=[0, split[0]], tickvals=at, ticktext=names, tickangle=-45, showgrid=False, ticks="", showline=False),
        xaxis2=axis(domain=[split[1], 1], range=[0, 1], tickformat=".0%", tickvals=[0, 0.5, 1], anchor="y"),
        yaxis=axis(tickvals=at, ticktext=names, range=[n - 0.5, -0.5], showgrid=False, ticks="", showline=False),
        margin={"l": round(left), "r": 60, "t": 34, "b": round(foot)},
    )  # fmt: skip


def importance(rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """What the flexible residual force depends on, the most important input on top."""
    ranked = sorted((r for r in rows if finite(r.get("importance"))), key=lambda r: r["importance"])
    bars = {
        "type": "bar", "orientation": "h", "x": [r["importance"] for r in ranked], "y": [text(r["input"], 32) for r in ranked],
        "marker": {"color": SKY, "line": {"color": INK, "width": 0.5}, "pattern": {"shape": "/", "fgcolor": "white", "size": 6}},
        "hovertemplate": "%{y}: %{x:.3g}<extra></extra>", "width": 0.62,
    }  # fmt: skip
    return figure([bars], 560, 62 + 24 * len(ranked), margin={"l": 130, "r": 12, "t": 8, "b": 44},
                  xaxis=axis("importance", rangemode="tozero"), yaxis=axis(showgrid=False, ticks=""))  # fmt: skip
