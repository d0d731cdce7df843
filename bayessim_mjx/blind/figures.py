"""Pictures of a blind check, for its page and for TensorBoard: found and missed cases, detection curves, confusion."""

import io
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from bayessim_mjx.blind.amounts import spoken
from bayessim_mjx.monitor.style import BLUE, GREY, SKY, blues, new_figure

COLUMNS = 4
RANGE = (1.0, 300.0)  # encoder noises
TICKS = (1, 3, 10, 30, 100, 300)
MISSED = "#D55E00"


def title(effect: str, where: str) -> str:
    return spoken(effect) if where in ("", "world") else f"{spoken(effect)}, {where}"


def _strengths(axes: Any) -> None:
    axes.set_xscale("log")
    axes.set_xlim(*RANGE)
    axes.set_xticks(TICKS, [str(t) for t in TICKS])
    axes.minorticks_off()
    axes.spines[["top", "right"]].set_visible(False)
    axes.tick_params(labelsize=8.5)


def overview(found: Mapping[str, Any]) -> Any:
    """Every effect and place that was tried: cases found and missed, and the strength that is found 9 times of 10."""
    rows = [r for r in found["thresholds"] if r["tried"]]
    figure = new_figure(9.6, 1.1 + 0.29 * max(len(rows), 1), layout="constrained")
    axes = figure.subplots()
    at = np.arange(len(rows))[::-1]
    for y, r in zip(at, rows, strict=True):
        middle, low, high = r["strength"]
        axes.plot([low, min(high, RANGE[1])], [y, y], color=SKY, linewidth=7, solid_capstyle="butt", zorder=1)
        if not r["beyond"]:
            axes.plot([middle] * 2, [y - 0.33, y + 0.33], color=BLUE, linewidth=2.2, zorder=2)
    place = {(r["effect"], r["where"]): y for y, r in zip(at, rows, strict=True)}
    for t in found["trials"]:
        y = place[t["effect"], t["where"]]
        face, edge = (BLUE, BLUE) if t["found"] else ("white", MISSED)
        x = float(np.clip(t["strength"], *RANGE))  # weaker and stronger ones at the edge
        axes.scatter(x, y, s=30, facecolor=face, edgecolor=edge, linewidth=1.4, zorder=3, clip_on=False)
    axes.set_yticks(at, [f"{title(r['effect'], r['where'])}   {r['told']}" for r in rows])
    _strengths(axes)
    axes.set_ylim(-0.7, len(rows) - 0.3)
    axes.set_xlabel("strength, encoder noises within half a second", fontsize=9)
    axes.grid(axis="x", color="#e6e9ec", zorder=0)
    axes.set_axisbelow(True)
    return figure


def curves(found: Mapping[str, Any]) -> Any:
    """How often each effect is found, by its strength, with 90 % bands."""
    shown = found["curves"]
    count = max(1, -(-len(shown) // COLUMNS))
    figure = new_figure(9.6, 0.5 + 1.55 * count, layout="constrained")
    grid = figure.subplots(count, COLUMNS, squeeze=False, sharex=True, sharey=True)
    for axes, (effect, (x, mean, low, high)) in zip(grid.flat, shown.items(), strict=False):
        axes.fill_between(x, low, high, color=SKY, alpha=0.6, linewidth=0)
        axes.plot(x, mean, color=BLUE, linewidth=1.6)
        axes.axhline(0.9, color=GREY, linewidth=0.7, linestyle=":")
        for t in (t for t in found["trials"] if t["effect"] == effect):
            colour = BLUE if t["found"] else MISSED
            axes.plot(t["strength"], float(t["found"]), "|", color=colour, markersize=8, markeredgewidth=1.5)
        axes.set_title(spoken(effect), fontsize=9, loc="left")
        _strengths(axes)
        axes.set_ylim(-0.08, 1.08)
        axes.set_yticks((0, 0.5, 0.9), ("0", "50", "90 %"))
    for axes in grid.flat[max(len(shown) - COLUMNS, 0) :]:  # below these there is nothing
        axes.tick_params(labelbottom=True)
    for axes in grid.flat[len(shown) :]:
        axes.set_visible(False)
    figure.supxlabel("strength, encoder noises within half a second", fontsize=9)
    return figure


def confusion(found: Mapping[str, Any]) -> Any:
    """Hidden against named, as counts."""
    matrix = found["confusion"]
    rows, columns = matrix["rows"], matrix["columns"]
    counts = np.array(matrix["counts"], float).reshape(len(rows), len(columns))
    figure = new_figure(2.8 + 0.34 * len(columns), 2.4 + 0.27 * len(rows), layout="constrained")
    axes = figure.subplots()
    share = counts / np.maximum(counts.sum(1, keepdims=True), 1)
    axes.imshow(share, cmap=blues(), vmin=0, vmax=1, aspect="auto")
    slanted = {"rotation": 60, "ha": "right", "rotation_mode": "anchor"}
    axes.set_xticks(range(len(columns)), _spoken(columns), fontsize=8.5, **slanted)
    axes.set_yticks(range(len(rows)), _spoken(rows), fontsize=8.5)
    axes.set_xlabel("said", fontsize=9)
    axes.set_ylabel("hidden", fontsize=9)
    for i, j in np.argwhere(counts):
        dark = "white" if share[i, j] > 0.6 else "black"
        axes.text(j, i, f"{counts[i, j]:.0f}", ha="center", va="center", fontsize=8.5, color=dark)
    return figure


def _spoken(names: Sequence[str]) -> list[str]:
    return [f"unknown: {spoken(n)}" if n.startswith("unknown_") else spoken(n) for n in names]


def pictures(found: Mapping[str, Any]) -> dict[str, Any]:
    """{tag: matplotlib Figure} of what there is to draw."""
    if not found["cases"]:
        return {}
    tried = {"overview": overview(found), "curves": curves(found)} if found["trials"] else {}
    return tried | {"confusion": confusion(found)}


def svg(figure: Any) -> str:
    """Write a figure as an SVG element whose letters are outlines, so that it looks the same everywhere."""
    import matplotlib

    with matplotlib.rc_context({"svg.fonttype": "path", "svg.hashsalt": "blind"}):
        text = io.StringIO()
        figure.savefig(text, format="svg", metadata={"Date": None})
    return text.getvalue()[text.getvalue().index("<svg") :]
