"""Picture of a calibration report: coverage of the posterior's regions, and the ranks of every parameter."""

import textwrap
from typing import Any

import numpy as np

from bayessim_mjx.monitor.names import shorten
from bayessim_mjx.monitor.style import BLUE, GREEN, GREY, RED, heading, new_figure
from bayessim_mjx.quantities import percent, percent_estimate

MOST = 8  # parameters by name, those whose ranks are least uniform
BAND = 1.36  # of sqrt(n) sup |F_n - F|: 95 % (Kolmogorov)


def calibration(report: Any, *, round: int | None = None, sets: Any = None) -> Any:
    """Left: share of truths inside the posterior's regions against their nominal mass. Right: ranks of each parameter.

    Args:
        report: inference.calibration.Report.
        round: for the heading.
        sets: inference.product_calibration.Sets, for a third picture: products as they are used.
    """
    figure = new_figure(11.0 if sets is None else 16.0, 5.2, layout="constrained")
    axes = figure.subplots(1, 2 if sets is None else 3)
    _coverage(axes[0], report)
    _ranks(axes[1], report)
    if sets is not None:
        _sets(axes[2], sets)
    figure.suptitle(textwrap.fill(heading(f"posterior {report.words}", round), 120), fontsize=11)
    return figure


def _ecdf(values: np.ndarray, at: np.ndarray) -> np.ndarray:
    return np.searchsorted(np.sort(values), at, side="right") / len(values)


def _coverage(axes: Any, report: Any) -> None:
    at = np.linspace(0, 1, 101)
    band = 2 * np.sqrt(at * (1 - at) / report.pairs)
    axes.fill_between(at, at - band, at + band, color=GREY, alpha=0.2, lw=0, label="calibrated, ± 2 standard errors")
    axes.plot(at, _ecdf(report.ranks.level, at), color=BLUE, lw=2, label="densest regions (HPD)")
    axes.plot(at, _ecdf(report.ranks.tarp, at), color=GREEN, lw=1.5, ls="--", label="regions around a point (TARP)")
    for level, (share, error) in report.coverage.items():
        reach = [[min(2 * error, share)], [min(2 * error, 1 - share)]]
        axes.errorbar([level], [share], yerr=reach, color="black", marker="o", ms=4, capsize=3, clip_on=False)
    axes.set(xlim=(0, 1), ylim=(0, 1), xlabel="probability of the region", ylabel="share of true parameters inside")
    axes.set_title("coverage: below the band the posterior is too narrow, above too wide", fontsize=9, loc="left")
    axes.legend(loc="upper left", frameon=False, fontsize=8)
    rows = [f"{percent(a)}:  {percent_estimate(c, e, 1)}" for a, (c, e) in report.coverage.items()]
    text = "\n".join(["observed coverage", *rows])
    axes.text(0.97, 0.03, text, ha="right", va="bottom", fontsize=8, linespacing=1.4, transform=axes.transAxes)


def _sets(axes: Any, sets: Any) -> None:
    """Coverage against the number of trajectories, as used; the gain stands above each number."""
    counts = [c.trajectories for c in sets.counts]
    for level, colour in zip((0.5, 0.8, 0.95), (BLUE, GREEN, RED), strict=True):
        error = np.asarray([np.sqrt(level * (1 - level) / len(c.levels)) for c in sets.counts])
        axes.fill_between(counts, level - 2 * error, np.minimum(level + 2 * error, 1), color=colour, alpha=0.12, lw=0)
        axes.axhline(level, color=colour, lw=0.6, ls=":")
        shares = [c.coverage(level) for c in sets.counts]
        axes.plot(counts, shares, color=colour, marker="o", lw=1.8, label=f"{percent(level)} region", clip_on=False)
    for c in sets.counts:
        axes.text(c.trajectories, 1.04, f"{c.gain:.1f}", ha="center", fontsize=8)
    axes.set_xscale("log", base=2)
    axes.set_xticks(counts, [str(n) for n in counts])
    axes.minorticks_off()
    axes.set(
        ylim=(0, 1.1), xlabel="trajectories", ylabel="share of true parameters inside (bands: ± 2 standard errors)"
    )
    title = "as used, on simulated sets; above: gain in nats"
    axes.set_title("\n".join([title, *textwrap.wrap(sets.saturation, 56)]), fontsize=9, loc="left")
    axes.legend(loc="lower left", frameon=False, fontsize=8)


def _ranks(axes: Any, report: Any) -> None:
    at, n = np.linspace(0, 1, 201), report.pairs
    half, stays = BAND / np.sqrt(n), "95 % of calibrated posteriors stay inside"
    axes.axhspan(-half, half, color=GREY, alpha=0.2, lw=0, label=stays)
    worst = np.argsort([report.p[name] for name in report.names])
    from matplotlib import colormaps

    colours = [RED, *colormaps["viridis"](np.linspace(0.1, 0.9, MOST - 1))]
    for k, i in enumerate(worst):
        style: dict[str, Any] = {"color": GREY, "alpha": 0.4}
        if k < MOST:
            name = f"{shorten(report.names, 34)[i]} (p = {report.p[report.names[i]]:.2g})"
            style = {"color": colours[k], "label": name}
        axes.plot(at, _ecdf(report.ranks.parameters[:, i], at) - at, lw=1.4, **style)
    axes.axhline(0, color="black", lw=0.6)
    axes.set(xlim=(0, 1), xlabel="rank of the true value among draws", ylabel="share below that rank, minus the rank")
    shapes = (
        "ranks: a hump is a posterior too high, a dip one too low;\nup then down is too narrow, down then up too wide"
    )
    axes.set_title(shapes, fontsize=9, loc="left")
    low, high = axes.get_ylim()
    wide = max(-low, high, 2 * half)
    lines = min(len(worst), MOST) + 1
    axes.set_ylim(-wide, wide * (1 + 0.11 * lines))  # room for the legend above the curves
    axes.legend(loc="upper right", frameon=False, fontsize=8)
