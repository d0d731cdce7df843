"""Where: forces that the simulator lacks over regions of the state, and frequency responses."""

from collections.abc import Mapping, Sequence
from typing import Any

from bayessim_mjx.monitor.style import BLUE
from bayessim_mjx.quantities import finite, unit
from bayessim_mjx.report.look import (
    DASH,
    FAINT,
    NARROW,
    STAGE,
    WIDTH,
    axis,
    cells,
    figure,
    folded,
    heading,
    layout_key,
    log_axis,
    numbers,
    panel,
    text,
)

MAPS_PER_ROW = 3


def maps(rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Disturbance force on one joint over what it may depend on: mean and interval per bin; significant ones filled."""
    return folded(_maps(rows, min(MAPS_PER_ROW, len(rows))), _maps(rows, 1))


def _maps(rows: Sequence[Mapping[str, Any]], columns: int) -> dict[str, Any]:
    lines = -(-len(rows) // columns)
    height = 66 + 190 * lines
    places = cells(len(rows), columns, 0.055, 82 / height)
    data, layout, titles = [], {}, []
    for k, (row, (across, up)) in enumerate(zip(rows, places, strict=True)):
        x, y = panel(k)
        data += _map(row, x, y)
        more = {"domain": across, "anchor": y, "showgrid": False, "nticks": 6}
        if row.get("axis") == "direction" and len(row["mean"]) == 2:
            ends = [row["edges"][0], row["edges"][-1]]
            more |= {"tickvals": _centres(row), "ticktext": ["backward", "forward"], "range": ends}
        in_unit = f" ({unit(row['unit'])})" if row.get("unit") else ""
        layout[layout_key(x)] = axis(text(row.get("axis", ""), 40) + in_unit, **more)
        share = {"matches": "y"} if k else {}
        first = k % columns == 0
        force = f"force ({unit(row.get('force_unit', ''))})" if first else ""
        zero = {"zeroline": True, "zerolinecolor": FAINT, "zerolinewidth": 1}
        layout[layout_key(y)] = axis(force, domain=up, anchor=x, nticks=6, showticklabels=first, **zero, **share)
        titles.append(heading(f"over {text(row.get('axis', ''), 40)}", x, y))
    return figure(
        data,
        WIDTH if columns == 3 else 320 * columns,
        height,
        least=max(240 * columns, NARROW),
        annotations=titles,
        margin={"l": 66, "r": 10, "t": 26, "b": 50},
        **layout,
    )


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
        out.append(
            {
                "type": "scatter",
                "mode": "markers",
                "xaxis": x,
                "yaxis": y,
                "marker": mark,
                "x": [centres[k] for k in pick],
                "y": [mean[k] for k in pick],
                "customdata": [counts[k] for k in pick],
                "error_y": {
                    "type": "data",
                    "symmetric": False,
                    "color": colour,
                    "thickness": 1.6,
                    "width": 0,
                    "array": [_reach(high[k], mean[k]) for k in pick],
                    "arrayminus": [_reach(mean[k], low[k]) for k in pick],
                },
                "hovertemplate": "%{x:.3g}: %{y:.3g} (%{customdata} samples)<extra></extra>",
            }
        )
    path = {
        "type": "scatter",
        "mode": "lines",
        "xaxis": x,
        "yaxis": y,
        "x": centres,
        "y": mean,
        "hoverinfo": "skip",
        "line": {"color": "#c9cfd4", "width": 1.2},
    }
    return out if row.get("axis") == "direction" else [path, *out]


def _reach(upper: float | None, lower: float | None) -> float:
    return max(upper - lower, 0.0) if upper is not None and lower is not None else 0.0


PANELS: tuple[tuple[str, str, str, dict[str, Any]], ...] = (  # (quantity, words, ending of its key, its axis)
    ("gain", "gain", "", {}),
    ("phase", "phase (deg)", "_deg", {}),
    ("coherence", "coherence", "", {"range": [0, 1.04]}),
)


def frequency(row: Mapping[str, Any]) -> dict[str, Any]:
    """Gain, phase and coherence from command to motion, measured and simulated; amplitudes by order, if any."""
    count = len(_panels(row)) + bool(row.get("orders"))
    return folded(_frequency(row, count), _frequency(row, 1))


def _panels(row: Mapping[str, Any]) -> list[tuple[str, str, str, dict[str, Any]]]:
    return [p for p in PANELS if row.get(f"{p[0]}_real{p[2]}") is not None]


def _frequency(row: Mapping[str, Any], columns: int) -> dict[str, Any]:
    panels = _panels(row)
    orders = row.get("orders") or []
    count = len(panels) + bool(orders)
    data: list[dict[str, Any]] = []
    layout: dict[str, Any] = {}
    titles = []
    height = 110 + 180 * -(-count // max(columns, 1))
    for k, (across, up) in enumerate(cells(count, columns, 0.075, 82 / height) if count else ()):
        x, y = panel(k)
        if k < len(panels):
            key, words, tail, more = panels[k]
            data += _responses(row, key, tail, (x, y), k == 0)
            layout[layout_key(x)] = log_axis("frequency (Hz)", row["hz"], domain=across, anchor=y)
            both = [v for who in ("real", "sim") for v in row.get(f"{key}_{who}{tail}") or []]
            logs = key == "gain" and any(finite(v) and v > 0 for v in both)
            place = {"anchor": x, "domain": up} | more
            layout[layout_key(y)] = log_axis("", both, **place) if logs else axis(nticks=6, **place)
        else:
            words = "residual by order"
            data.append(_by_order(orders, x, y))
            layout[layout_key(x)] = axis("cycles per revolution", domain=across, anchor=y, showgrid=False)
            layout[layout_key(y)] = axis(anchor=x, nticks=6, domain=up)
        titles.append(heading(words, x, y))
    legend = {"orientation": "h", "x": 0, "y": 1 + 23 / (height - 110), "yanchor": "bottom", "font": {"size": 12}}
    return figure(
        data,
        WIDTH,
        height,
        least=NARROW if columns <= 1 else 720,
        showlegend=bool(panels),
        annotations=titles,
        legend=legend,
        margin={"l": 50, "r": 12, "t": 62, "b": 48},
        **layout,
    )


def _responses(row: Mapping[str, Any], key: str, tail: str, at: tuple[str, str], legend: bool) -> list[dict[str, Any]]:
    """Measured and simulated curves of one quantity in the panel with axes `at`."""
    out = []
    for who, style in (("real", "measured"), ("sim", "calibrated")):
        if row.get(f"{key}_{who}{tail}") is None:
            continue
        out.append(
            {
                "type": "scatter",
                "mode": "lines",
                "x": numbers(row["hz"]),
                "y": numbers(row[f"{key}_{who}{tail}"]),
                "xaxis": at[0],
                "yaxis": at[1],
                "line": {"color": STAGE[style], "width": 1.8, "dash": DASH[style]},
                "showlegend": legend,
                "name": "measured" if who == "real" else "recalibrated simulation",
                "hovertemplate": "%{x:.3g} Hz: %{y:.3g}<extra></extra>",
            }
        )
    return out


def _by_order(orders: Sequence[Mapping[str, Any]], x: str, y: str) -> dict[str, Any]:
    return {
        "type": "bar",
        "x": [o.get("order") for o in orders],
        "y": numbers([o.get("amplitude") for o in orders]),
        "xaxis": x,
        "yaxis": y,
        "marker": {"color": BLUE},
        "showlegend": False,
        "hovertemplate": "order %{x}: %{y:.3g}<extra></extra>",
    }
