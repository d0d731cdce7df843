"""What these logs can tell: estimates per operating condition, isolability, and what the flexible force depends on."""

from collections.abc import Mapping, Sequence
from typing import Any

from bayessim_mjx.diagnosis.phrases.effects import label_title
from bayessim_mjx.monitor.style import SKY
from bayessim_mjx.quantities import finite, unit
from bayessim_mjx.report.look import (
    COLUMN,
    FAINT,
    INK,
    NARROW,
    OVER,
    STAGE,
    WIDTH,
    axis,
    cells,
    figure,
    folded,
    heading,
    layout_key,
    note,
    numbers,
    panel,
    text,
)
from bayessim_mjx.report.words import percent

MOST_LABELS = 36


def fits(names: Sequence[str]) -> bool:
    """Whether the conditions' names fit under a panel; else they are numbered."""
    return len(names) * max((len(str(n)) for n in names), default=0) <= 34


def groups(
    names: Sequence[str], parameters: Mapping[str, Mapping[str, Any]], known: Mapping[str, Any]
) -> dict[str, Any]:
    """Estimates of each parameter per operating condition (mean and 2 sd); dotted: the simulator's own value."""
    shown = dict(list(parameters.items())[:12])
    return folded(_groups(names, shown, known, min(3, len(shown))), _groups(names, shown, known, 1))


def _groups(
    names: Sequence[str], shown: Mapping[str, Mapping[str, Any]], known: Mapping[str, Any], columns: int
) -> dict[str, Any]:
    height = 40 + 176 * -(-len(shown) // columns)
    labels = [text(n, 16) for n in names] if fits(names) else [str(k + 1) for k in range(len(names))]
    data, layout, titles, levels = [], {}, [], []
    places = cells(len(shown), columns, 0.07, 70 / height)
    for k, ((name, row), (across, up)) in enumerate(zip(shown.items(), places, strict=True)):
        x, y = panel(k)
        moves = bool(known.get(name, {}).get("structural"))
        colour = STAGE["nominal"] if moves else STAGE["with_effects"]
        spread = [2 * s if finite(s) else 0 for s in row.get("sd") or [0.0] * len(names)]
        data.append(
            {
                "type": "scatter",
                "mode": "markers",
                "x": list(range(len(names))),
                "y": numbers(row["mean"]),
                "xaxis": x,
                "yaxis": y,
                "marker": {"color": colour, "size": 8, "symbol": "diamond" if moves else "circle"},
                "error_y": {"type": "data", "array": spread, "color": colour, "thickness": 1.6, "width": 0},
                "hovertemplate": "%{y:.4g}<extra></extra>",
            }
        )
        ticks: dict[str, Any] = {
            "tickvals": list(range(len(names))),
            "ticktext": labels,
            "showgrid": False,
        }
        layout[layout_key(x)] = axis(domain=across, anchor=y, range=[-0.6, len(names) - 0.4], **ticks)
        layout[layout_key(y)] = axis(domain=up, anchor=x, nticks=5)
        in_unit = unit(str(known.get(name, {}).get("unit") or ""))
        titles.append(heading(text(name, 34) + (f" ({in_unit})" if in_unit else ""), x, y))
        levels += _level(known.get(name, {}).get("nominal"), x, y)
    return figure(
        data,
        WIDTH if columns == 3 else 320 * columns,
        height,
        least=max(240 * columns, NARROW),
        annotations=titles,
        shapes=levels,
        margin={"l": 60, "r": 10, "t": 28, "b": 46},
        **layout,
    )


def _level(value: Any, x: str, y: str) -> list[dict[str, Any]]:
    line = {"color": FAINT, "width": 1.2, "dash": "dot"}
    place = {"type": "line", "xref": f"{x} domain", "x0": 0, "x1": 1, "yref": y, "y0": value, "y1": value}
    return [place | {"line": line}] if finite(value) else []


def isolability(labels: Sequence[str], cosine: Sequence[Sequence[float]], absorbed: Sequence[float]) -> dict[str, Any]:
    """|cos| between what effects do to these logs (lower triangle), and the share that known parameters would hide."""
    n = min(len(labels), MOST_LABELS)
    names = [text(label_title(label, short=True), 46) for label in labels[:n]]
    table = [[numbers([cosine[i][j]])[0] if j <= i else None for j in range(n)] for i in range(n)]
    hide = [absorbed[i] if i < len(absorbed) and finite(absorbed[i]) else None for i in range(n)]
    cell = 30 if n <= 18 else 20
    at = list(range(n))
    values = [
        note(
            f"{v:.2f}".replace("0.", ".") if v < 0.995 else "1",
            j,
            i,
            xref="x",
            yref="y",
            font={"size": 11 if cell == 30 else 8.5, "color": "white" if v > 0.72 else INK},
        )
        for i, row in enumerate(table)
        for j, v in enumerate(row)
        if v is not None and j < i and v >= (0.3 if cell == 30 else 0.8)
    ]
    left = 8 + 6.6 * max(map(len, names), default=10)
    rows = names if cell == 30 else [f"{name}  <b>{k + 1}</b>" for k, name in enumerate(names)]
    below = names if cell == 30 else [str(k + 1) for k in at]  # long names would overlap there
    foot = 0.72 * left + 14 if cell == 30 else 40
    side = cell * n
    width = WIDTH if left + side + 170 > 700 else round(left + side + 250)
    split = (side / (width - left - 60), (side + 30) / (width - left - 60))
    split = split if split[1] < 0.85 else (0.78, 0.82)
    over = [heading("similarity |cos|", "x", "y"), heading("hidden share", "x2", "y")]
    return figure(
        [_similar(table, names), _hidden(hide)],
        width,
        round(side + 34 + foot),
        least=width,
        annotations=[*over, *values],
        xaxis=axis(
            domain=[0, split[0]],
            tickvals=at,
            ticktext=below,
            tickfont={"size": 12 if cell == 30 else 8.5},
            tickangle=-45 if cell == 30 else 0,
            showgrid=False,
            ticks="",
            showline=False,
        ),
        xaxis2=axis(domain=[split[1], 1], range=[0, 1], tickformat=".0%", tickvals=[0, 0.5, 1], anchor="y"),
        yaxis=axis(tickvals=at, ticktext=rows, range=[n - 0.5, -0.5], showgrid=False, ticks="", showline=False),
        margin={"l": round(left), "r": 60, "t": 34, "b": round(foot)},
    )


def _similar(table: Sequence[Sequence[float | None]], names: Sequence[str]) -> dict[str, Any]:
    n, at = len(names), list(range(len(names)))
    return {
        "type": "heatmap",
        "z": table,
        "x": at,
        "y": at,
        "zmin": 0,
        "zmax": 1,
        "xgap": 1,
        "ygap": 1,
        "hoverongaps": False,
        "colorscale": [[0, "#f7fafc"], [0.5, SKY], [1, "#00507d"]],
        "showscale": False,
        "customdata": [[f"{names[i]}<br>and {names[j]}" for j in range(n)] for i in range(n)],
        "hovertemplate": "%{customdata}<br>|cos| = %{z:.2f}<extra></extra>",
    }


def _hidden(hide: Sequence[float | None]) -> dict[str, Any]:
    at = list(range(len(hide)))
    return {
        "type": "bar",
        "orientation": "h",
        "x": hide,
        "y": at,
        "xaxis": "x2",
        "yaxis": "y",
        "width": 0.62,
        "marker": {"color": "#E69F00", "line": {"color": INK, "width": 0.5}},
        "text": [percent(h) for h in hide],
        "textposition": "outside",
        "cliponaxis": False,
        "hoverinfo": "skip",
        "textfont": {"size": 11},
    }


def importance(rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Draw the inputs of the flexible residual force, the most important one on top."""
    ranked = sorted((r for r in rows if finite(r.get("importance"))), key=lambda r: r["importance"])
    bars = {
        "type": "bar",
        "orientation": "h",
        "x": [r["importance"] for r in ranked],
        "y": [text(r["input"], 32) for r in ranked],
        "marker": {"color": SKY, "line": {"color": INK, "width": 0.5}, "pattern": {"shape": "/", **OVER}},
        "hovertemplate": "%{y}: %{x:.3g}<extra></extra>",
        "width": 0.62,
    }
    return figure(
        [bars],
        COLUMN,
        62 + 24 * len(ranked),
        least=NARROW,
        margin={"l": 130, "r": 12, "t": 8, "b": 44},
        xaxis=axis("importance", rangemode="tozero"),
        yaxis=axis(showgrid=False, ticks=""),
    )
