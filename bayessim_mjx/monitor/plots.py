"""Pictures of posteriors and of how simulation follows reality, as matplotlib Figures (no pyplot, no global state)."""

import textwrap
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from bayessim_mjx.monitor.draws import Draws, draws_of
from bayessim_mjx.monitor.panels import (
    best_first,
    correlation,
    few_ticks,
    intervals,
    joint,
    label,
    limits_of,
    marginal,
    median_in_words,
    natural,
    prior_range,
    triangle,
    zoomed,
)
from bayessim_mjx.monitor.predictive import predictive
from bayessim_mjx.monitor.style import BLUE, GREEN, GREY, RED, handles, head, heading, new_figure, size_of
from bayessim_mjx.monitor.tables import shorten
from bayessim_mjx.quantities import compact, fixed, percent, percent_estimate

__all__ = ["corner", "pair", "predictive"]

FULL_CORNER = 12  # up to so many parameters every pair is drawn
MOST = 8  # parameters by name, those whose ranks are least uniform
BAND = 1.36  # of sqrt(n) sup |F_n - F|: 95 % (Kolmogorov)
STAYS = "95 % of calibrated posteriors stay inside"


def corner(
    samples: Any,
    names: Sequence[str] | None = None,
    low: Any = None,
    high: Any = None,
    truth: Any = None,
    prior: Any = None,
    *,
    units: Sequence[str] | None = None,
    log: Any = None,
    title: str | None = None,
    round: int | None = None,
    best: int = 6,
    truth_label: str = "truth",
) -> Any:
    """Plot the posterior over all parameters: every pair up to 12, above that an overview and the `best`.

    Args:
        samples: Distribution, or samples [n, d] with `names`, `low`, `high` [d].
        truth: [d] or {name: value}, where known (a surrogate).
        prior: Distribution or samples [m, d]; None: the space's own prior.
        log: [d] bool, parameters to show on a log axis; None: those with a log-uniform prior.
        title, round: what the title says; `round` is put in front.
        truth_label: what the red line is, where it is not a truth (a published value, say).
    """
    draws = draws_of(samples, names, low, high, prior, units, log)
    true = draws.coordinate(_truth(truth, draws.names))
    text = heading(title or f"posterior over {draws.d} parameter{'s' * (draws.d > 1)}", round)
    items = ["posterior", "prior"] + ["truth"] * (true is not None) + ["regions"] * (draws.d > 1)
    if draws.d > FULL_CORNER:
        figure = _overview(draws, true, best)
    else:
        cell = max(1.25, min(2.3, 8.5 / draws.d))
        figure = new_figure(*((6.2, 4.2) if draws.d == 1 else (cell * draws.d + 1.2, cell * draws.d + 1.6)))
        triangle(figure, draws, true)
    head(figure, text, items, truth_label)
    return figure


def _overview(draws: Draws, true: np.ndarray | None, best: int) -> Any:
    """All parameters as intervals on the left, the corner of the best and all correlations on the right."""
    figure = new_figure(16.5, max(12.0, 1.8 + 0.26 * draws.d))
    left, right = figure.subfigures(1, 2, width_ratios=(1.0, 1.05))
    above, below = right.subfigures(2, 1, height_ratios=(1.25, 1.0))
    height = size_of(left)[1]
    intervals(left.add_axes((0.36, 0.75 / height, 0.52, 1 - 1.65 / height)), draws, true)
    order = best_first(draws)[:best]
    triangle(above, draws.pick(order), None if true is None else true[order], top=0.95)
    above.text(0.6, 1 - 0.62 / size_of(above)[1], f"the {best} best identified", fontsize=9, ha="center", va="top")
    correlation(below, draws)
    return figure


def pair(
    posterior: Any,
    i: int | str = 0,
    j: int | str = 1,
    truth: Any = None,
    *,
    names: Sequence[str] | None = None,
    low: Any = None,
    high: Any = None,
    prior: Any = None,
    means: Any = None,
    units: Sequence[str] | None = None,
    log_gain: float | None = None,
    round: int | None = None,
) -> Any:
    """BayesSimIG's picture of two parameters: both marginals, and their joint density with contours.

    Args:
        posterior: Distribution, or samples [n, d] with `names`, `low`, `high`.
        i, j: the two parameters, by number or name.
        truth: [d] or {name: value}. means: [K, d] component means (a Distribution brings its own).
        log_gain: log posterior - log prior at the truth, in nats, for the text panel.
    """
    whole = draws_of(posterior, names, low, high, prior, units, means=means)
    index = [_number(k, whole.names) for k in (i, j)]
    draws, true = whole.pick(index), whole.coordinate(_truth(truth, whole.names))
    true = None if true is None else true[index]
    figure = new_figure(8.0, 7.2, layout="constrained")
    grid = figure.subplots(2, 2)
    limits = [limits_of(draws, k, true) for k in range(2)]
    part = [f"   (prior {prior_range(draws, k)})" if zoomed(draws, k, limits[k]) else "" for k in range(2)]
    labels = [label(draws, k, 40, 2) for k in range(2)]
    for axes, k in ((grid[0, 0], 0), (grid[1, 1], 1)):
        marginal(axes, draws, k, true, limits[k])
        axes.set(xlabel=labels[k] + part[k], ylabel="density")
    joint(grid[1, 0], draws, (0, 1), true, (*limits[0], *limits[1]), star=True)
    grid[1, 0].set(xlabel=labels[0], ylabel=labels[1])
    for axes, place in ((grid[0, 0], (0, 0)), (grid[1, 1], (1, 1)), (grid[1, 0], (0, 1))):
        few_ticks(axes, draws, place, (3.2, 2.8))
    grid[0, 1].axis("off")
    grid[0, 1].text(0.0, 1.0, _facts(draws, true, log_gain), va="top", fontsize=9, linespacing=1.4)
    known = ["truth", "star"] if true is not None else []
    marks, texts = handles(["posterior", "prior", "regions", *known] + ["means"] * (draws.means is not None))
    grid[0, 1].legend(marks, texts, loc="lower left", frameon=False, fontsize=8, ncols=2)
    what = heading(f"posterior, {draws.names[0]} against {draws.names[1]}", round)
    figure.suptitle(shorten([what], 78, 2)[0], fontsize=11)
    return figure


def _facts(draws: Draws, true: np.ndarray | None, log_gain: float | None) -> str:
    lines = []
    for k, width in enumerate(draws.numbers.width):
        unit = f" {draws.units[k]}" if draws.units[k] else ""
        lines += [shorten(draws.names, 44)[k], f"    median, 68 %   {median_in_words(draws, k)}{unit}"]
        lines += [f"    truth   {compact(natural(draws, k, true[k]))}{unit}"] if true is not None else []
        lines += [f"    posterior/prior sd   {width:.2g}", ""]
    lines += [f"correlation   {fixed(draws.numbers.correlation[0, 1], 2)}"]
    lines += [f"log gain at the truth   {log_gain:+.2f} nats"] if log_gain is not None else []
    return "\n".join(lines)


def _number(parameter: int | str, names: Sequence[str]) -> int:
    if isinstance(parameter, str) and parameter in names:
        return list(names).index(parameter)
    if not isinstance(parameter, str) and 0 <= int(parameter) < len(names):
        return int(parameter)
    raise ValueError(f"no parameter {parameter!r}; there are {list(names)}")


def _truth(truth: Any, names: Sequence[str]) -> np.ndarray | None:
    if truth is None:
        return None
    if isinstance(truth, Mapping) and set(names) - set(truth):
        raise ValueError(f"truth lacks {sorted(set(names) - set(truth))}")
    vector = np.array([truth[n] for n in names] if isinstance(truth, Mapping) else truth, float)
    if vector.shape != (len(names),):
        raise ValueError(f"truth has shape {vector.shape}; expected [{len(names)}] for {list(names)}")
    return vector


def calibration(report: Any, *, round: int | None = None, sets: Any = None, replaced: bool = False) -> Any:
    """Left: share of truths inside the posterior's regions against their nominal mass. Right: ranks of each parameter.

    Args:
        report: inference.calibration.Report.
        round: for the heading.
        sets: inference.product_calibration.Sets, for a third picture: products as they are used.
        replaced: whether the posterior in use is another one, that of replays.
    """
    figure = new_figure(11.0 if sets is None else 16.0, 5.2, layout="constrained")
    axes = figure.subplots(1, 2 if sets is None else 3)
    _coverage(axes[0], report)
    _ranks(axes[1], report)
    if sets is not None:
        _sets(axes[2], sets)
    title = textwrap.fill(heading(f"network's posterior {report.words}", round), 120)
    figure.suptitle(title + "\nThe posterior in use is that of the replays." * replaced, fontsize=11)
    return figure


def _ecdf(values: np.ndarray, at: np.ndarray) -> np.ndarray:
    return np.searchsorted(np.sort(values), at, side="right") / len(values)


def _coverage(axes: Any, report: Any) -> None:
    at = np.linspace(0, 1, 101)
    half = BAND / np.sqrt(report.pairs)
    low, high = np.maximum(at - half, 0), np.minimum(at + half, 1)
    axes.fill_between(at, low, high, color=GREY, alpha=0.2, lw=0, label=STAYS)
    axes.plot(
        at,
        _ecdf(report.ranks.level, at),
        color=BLUE,
        lw=2,
        label=f"densest regions (HPD{_of_ranks(report, 'HPD level')})",
    )
    label = f"regions around a point (TARP{_of_ranks(report, 'TARP')})"
    axes.plot(at, _ecdf(report.ranks.tarp, at), color=GREEN, lw=1.5, ls="--", label=label)
    for name, masses in report.intervals().items():  # the verdict rests on these
        axes.plot(at, _ecdf(masses, at), color=RED, lw=1.5, label=f"intervals of {shorten([name], 30)[0]}")
    for level, (share, error) in report.coverage.items():
        reach = [[min(2 * error, share)], [min(2 * error, 1 - share)]]
        bar = axes.errorbar([level], [share], yerr=reach, color="black", marker="o", ms=4, capsize=3, clip_on=False)
    bar.set_label("HPD coverage, ± 2 standard errors")
    axes.set(xlim=(0, 1), ylim=(0, 1), xlabel="probability of the region", ylabel="share of true parameters inside")
    axes.set_title("coverage: below the band the posterior is too narrow, above too wide", fontsize=9, loc="left")
    axes.legend(loc="upper left", frameon=False, fontsize=8)
    what, shares = next(iter(report.interval_coverage().items()), ("HPD coverage", report.coverage))
    rows = [f"{percent(level)}:  {percent_estimate(share, error, 1)}" for level, (share, error) in shares.items()]
    text = "\n".join([shorten([what], 36)[0], *rows])
    axes.text(0.97, 0.03, text, ha="right", va="bottom", fontsize=8, linespacing=1.4, transform=axes.transAxes)


def _of_ranks(report: Any, test: str) -> str:
    """`, p = 0.24` that the ranks of a test of all parameters are uniform."""
    return f", p = {report.p[test]:.2g}"


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
        axes.text(c.trajectories, 1.04, fixed(c.gain, 1), ha="center", fontsize=8)
    axes.set_xscale("log", base=2)
    axes.set_xticks(counts, [str(n) for n in counts])
    axes.minorticks_off()
    axes.set(ylim=(0, 1.1), xlabel="trajectories", ylabel="share of true parameters inside")
    title = "posteriors of several trajectories, on simulated sets\nbands: ± 2 standard errors; on top: gain in nats"
    axes.set_title("\n".join([title, *textwrap.wrap(sets.saturation, 56)]), fontsize=9, loc="left")
    axes.legend(loc="lower left", frameon=False, fontsize=8)


def _ranks(axes: Any, report: Any) -> None:
    at, n = np.linspace(0, 1, 201), report.pairs
    half = BAND / np.sqrt(n)
    axes.axhspan(-half, half, color=GREY, alpha=0.2, lw=0, label=STAYS)
    faults = report.moments()
    worst = sorted(range(len(report.names)), key=lambda i: (report.names[i] not in faults, report.p[report.names[i]]))
    from matplotlib import colormaps

    colours = [RED, *colormaps["viridis"](np.linspace(0.1, 0.9, MOST - 1))]
    for k, i in enumerate(worst):
        style: dict[str, Any] = {"color": GREY, "alpha": 0.4}
        if k < MOST:
            also = f"; {faults[report.names[i]]}" if report.names[i] in faults else ""
            name = f"{shorten(report.names, 34)[i]} (p = {report.p[report.names[i]]:.2g}{also})"
            style = {"color": colours[k], "label": name}
        axes.plot(at, _ecdf(report.ranks.parameters[:, i], at) - at, lw=1.4, **style)
    axes.axhline(0, color="black", lw=0.6)
    axes.set(xlim=(0, 1), xlabel="rank of the true value among draws", ylabel="share below that rank, minus the rank")
    shapes = (
        "ranks: a hump is a posterior too high, a dip one too low;\nup then down is too narrow, down then up too wide"
    )
    limits = f"a fault: p below {report.limit:.3g}; of mean or spread of ranks, below {report.moment_limit:.3g}"
    axes.set_title(f"{shapes}\n{limits}", fontsize=9, loc="left")
    low, high = axes.get_ylim()
    wide = max(-low, high, 2 * half)
    lines = min(len(worst), MOST) + 1
    axes.set_ylim(-wide, wide * (1 + 0.11 * lines))  # room for the legend above the curves
    axes.legend(loc="upper right", frameon=False, fontsize=8)
