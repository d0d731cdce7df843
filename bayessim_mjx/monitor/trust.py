"""Picture of a calibration report: coverage of the posterior's regions, and the ranks of every parameter."""

import textwrap
from typing import Any

import numpy as np

from bayessim_mjx.monitor.draws import shorten
from bayessim_mjx.monitor.style import BLUE, GREEN, GREY, RED, heading, new_figure

MOST = 8  # parameters by name, those whose ranks are least uniform
BAND = 1.36  # of sqrt(n) sup |F_n - F|: 95 % (Kolmogorov)


def calibration(report: Any, *, round: int | None = None) -> Any:
    """Left: share of truths inside the posterior's regions against their nominal mass. Right: ranks of each parameter.

    Args:
        report: inference.calibration.Report.
    """
    figure = new_figure(11.0, 5.2, layout="constrained")
    left, right = figure.subplots(1, 2)
    _coverage(left, report)
    _ranks(right, report)
    figure.suptitle(textwrap.fill(heading(f"posterior {report.words}", round), 120), fontsize=11)
    return figure


def _ecdf(values: np.ndarray, at: np.ndarray) -> np.ndarray:
    return np.searchsorted(np.sort(values), at, side="right") / len(values)


def _coverage(axes: Any, report: Any) -> None:
    at = np.linspace(0, 1, 101)
    band = 2 * np.sqrt(at * (1 - at) / report.pairs)
    axes.fill_between(at, at - band, at + band, color=GREY, alpha=0.2, lw=0, label="calibrated, 2 standard errors")
    axes.plot(at, _ecdf(report.ranks.level, at), color=BLUE, lw=2, label="densest regions (HPD)")
    axes.plot(at, _ecdf(report.ranks.tarp, at), color=GREEN, lw=1.5, ls="--", label="regions around a point (TARP)")
    for level, (share, error) in report.coverage.items():
        axes.errorbar([level], [share], yerr=[2 * error], color="black", marker="o", ms=4, capsize=3)
        near = {"textcoords": "offset points", "xytext": (8, -12), "fontsize": 8}
        axes.annotate(f"{100 * share:.0f} of {100 * level:.0f} %", (level, share), **near)
    axes.set(xlim=(0, 1), ylim=(0, 1), xlabel="mass of the region", ylabel="share of truths inside")
    axes.set_title("coverage: below the band is over-confident, above is too wide", fontsize=9, loc="left")
    axes.legend(loc="upper left", frameon=False, fontsize=8)


def _ranks(axes: Any, report: Any) -> None:
    at, n = np.linspace(0, 1, 201), report.pairs
    axes.axhspan(-BAND / np.sqrt(n), BAND / np.sqrt(n), color=GREY, alpha=0.2, lw=0, label="95 % of calibrated ones")
    worst = np.argsort([report.p[name] for name in report.names])
    from matplotlib import colormaps

    colours = [RED, *colormaps["viridis"](np.linspace(0.1, 0.9, MOST - 1))]
    for k, i in enumerate(worst):
        named = {"color": colours[k], "label": f"{shorten(report.names, 34)[i]} (p = {report.p[report.names[i]]:.2g})"}
        style: dict[str, Any] = named if k < MOST else {"color": GREY, "alpha": 0.4}
        axes.plot(at, _ecdf(report.ranks.parameters[:, i], at) - at, lw=1.4, **style)
    axes.axhline(0, color="black", lw=0.6)
    axes.set(xlim=(0, 1), xlabel="rank of the truth among the draws", ylabel="excess share of truths below that rank")
    axes.set_title("ranks: above 0 draws lie too high, S-shape too narrow (up first) or wide", fontsize=9, loc="left")
    axes.legend(loc="best", frameon=False, fontsize=8)
    low, high = axes.get_ylim()
    wide = max(-low, high, 2 * BAND / np.sqrt(n))
    axes.set_ylim(-wide, wide)
