"""Colours, line styles and the layout that every figure of a report shares; figures are plain dicts for plotly.js.

The stages go from vermilion over orange to blue, whose lightness differs too, so that they survive a grey printer;
lines also differ in dashes, areas in hatching.
"""

import html
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from bayessim_mjx.monitor.style import BLUE, SKY
from bayessim_mjx.report.words import finite

INK, FAINT, GRID = "#1f2429", "#6a737d", "#e6e9ec"
STAGE = {
    "nominal": "#D55E00",
    "calibrated": "#E69F00",
    "with_effects": BLUE,
    "reducible_floor": SKY,
    "noise_floor": "#A6ACB2",
    "measured": "#000000",
}
_REPAIRED = ("blue", "#005f96")
TONES = {  # verdict: (colour on the terminal, on the page)
    "no_gap": ("green", "#00755a"),
    "parameters": _REPAIRED,
    "noise": _REPAIRED,
    "effects": _REPAIRED,
    "ambiguous": ("yellow", "#8a5a00"),
    "unexplained": ("red", "#b14a00"),
    "insufficient_data": ("white", "#5b6670"),
}
DASH = {"nominal": "dot", "calibrated": "dash", "with_effects": "solid", "measured": "solid"}
HATCH = {"nominal": "", "calibrated": "", "with_effects": "", "reducible_floor": "/", "noise_floor": "."}
OVER = {"fillmode": "overlay", "fgcolor": "white", "size": 6}  # hatching over the colour
FONT = "system-ui, -apple-system, 'Segoe UI', Roboto, 'Helvetica Neue', Arial, sans-serif"
WIDTH = 960  # of the page's column on a wide screen and on paper, px
COLUMN = WIDTH // 2 - 20  # of one of two columns side by side, px
LEAST = 560  # px, of most figures on a narrow one
NARROW = 320  # px, of figures that a phone shows whole


def text(value: Any, length: int = 60) -> str:
    """Return a string for plotly, which reads some HTML: shortened and escaped."""
    plain = str(value)
    plain = plain if len(plain) <= length else plain[: length - 1] + "…"
    return html.escape(plain, quote=False)


def numbers(values: Any, digits: int = 5) -> list[float | None]:
    """Values for JSON: not finite becomes None, rounded to `digits` of the largest magnitude."""
    array = np.array([v if finite(v) else np.nan for v in np.asarray(values, dtype=object).tolist()], float)
    known = np.abs(array[np.isfinite(array)])
    if known.size == 0 or known.max() == 0:
        return [None if np.isnan(v) else float(v) for v in array]
    decimals = int(digits - 1 - np.floor(np.log10(known.max())))
    return [None if not np.isfinite(v) else float(round(v, decimals)) for v in array.tolist()]


def axis(title: str = "", **more: Any) -> dict[str, Any]:
    """Return an axis with faint grid lines; `more` are plotly's own settings."""
    base = {
        "showgrid": True,
        "gridcolor": GRID,
        "zeroline": False,
        "linecolor": "#9aa3ab",
        "showline": True,
        "ticks": "outside",
        "ticklen": 4,
        "tickcolor": "#9aa3ab",
        "automargin": True,
        "title": {"text": title, "font": {"size": 12.5, "color": INK}, "standoff": 8},
    }
    return base | more


def figure(data: list[dict], width: int, height: int, *, least: int = LEAST, **layout: Any) -> dict[str, Any]:
    """Make {"data", "layout", "width", "height", "least"} of a figure, without plotly's own colours, title or legend.

    least: px, the width below which it cannot be read; narrower screens scroll.
    """
    base = {
        "width": width,
        "height": height,
        "paper_bgcolor": "white",
        "plot_bgcolor": "white",
        "showlegend": False,
        "font": {"family": FONT, "size": 12, "color": INK},
        "margin": {"l": 60, "r": 16, "t": 30, "b": 46},
        "hoverlabel": {
            "bgcolor": "white",
            "bordercolor": "#9aa3ab",
            "font": {"family": FONT, "size": 12, "color": INK},
        },
        "legend": {"orientation": "h", "x": 0, "y": 1.02, "xanchor": "left", "yanchor": "bottom", "font": {"size": 12}},
        "dragmode": "zoom",
        "hovermode": "closest",
    }
    return {"data": data, "layout": base | layout, "width": width, "height": height, "least": min(least, width)}


def folded(wide: dict[str, Any], narrow: dict[str, Any]) -> dict[str, Any]:
    """Return a figure that has the layout of another one, of the same traces, on a screen below its least width."""
    return wide | {"narrow": {k: narrow[k] for k in ("layout", "height", "least")}}


def log_ticks(values: Sequence[Any]) -> list[float]:
    """1, 2, 5, 10, 20 ... between the smallest and the largest positive value, thinned out to at most about eight."""
    known = [v for v in values if finite(v) and v > 0]
    if not known:
        return [1.0]
    low, high = np.floor(np.log10(min(known))), np.ceil(np.log10(max(known)))
    digits = (1, 2, 5) if high - low <= 2 else (1, 3) if high - low <= 4 else (1,)
    ticks = [float(f"{d}e{int(p)}") for p in np.arange(low, high + 1) for d in digits]
    return [t for t in ticks if min(known) / 1.8 <= t <= max(known) * 1.8]


def log_axis(title: str, values: Sequence[Any], **more: Any) -> dict[str, Any]:
    """Return a logarithmic axis whose ticks are whole numbers that people read, without plotly's small 2s and 5s."""
    ticks = log_ticks(values)
    return axis(title, type="log", tickvals=ticks, ticktext=[f"{t:g}" for t in ticks], **more)


def note(words: str, x: float, y: float, **more: Any) -> dict[str, Any]:
    """Return an annotation without an arrow; in fractions of the figure unless `xref`, `yref` say otherwise."""
    base = {"text": words, "x": x, "y": y, "xref": "paper", "yref": "paper", "showarrow": False, "font": {"size": 12}}
    return base | more


def heading(words: str, x_axis: str, y_axis: str) -> dict[str, Any]:
    """Return a panel's title, left above the panel of these axes (`x2`, `y2` ...)."""
    style = {"xanchor": "left", "yanchor": "bottom", "yshift": 4, "font": {"size": 12.5, "weight": 600}}
    return note(words, 0, 1, xref=f"{x_axis} domain", yref=f"{y_axis} domain", **style)


def panel(k: int) -> tuple[str, str]:
    """Names of the axes of panel k as traces call them: x, y; x2, y2; ..."""
    tail = "" if k == 0 else str(k + 1)
    return f"x{tail}", f"y{tail}"


def layout_key(name: str) -> str:
    """`x2` -> `xaxis2`, as layouts call it."""
    return f"{name[0]}axis{name[1:]}"


def cells(count: int, columns: int, gap_x: float, gap_y: float) -> list[tuple[list[float], list[float]]]:
    """Domains (x, y) of `count` panels in rows of `columns`, from the top left; gaps in fractions of the figure."""
    rows = -(-count // columns)
    wide, high = (1 - gap_x * (columns - 1)) / columns, (1 - gap_y * (rows - 1)) / rows
    out = []
    for k in range(count):
        left, top = (k % columns) * (wide + gap_x), 1 - (k // columns) * (high + gap_y)
        out.append(([left, left + wide], [max(top - high, 0.0), top]))
    return out


def broken(values: Iterable[Any], breaks: Sequence[int]) -> list[Any]:
    """`values` with None before each index of `breaks`, so that the line is interrupted there."""
    out: list[Any] = []
    stops = set(breaks)
    for k, value in enumerate(values):
        if k in stops and k:
            out.append(None)
        out.append(value)
    return out
