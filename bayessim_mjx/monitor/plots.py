"""Pictures of posteriors and of how simulation follows reality, as matplotlib Figures (no pyplot, no global state)."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from bayessim_mjx.monitor.draws import Draws, draws_of
from bayessim_mjx.monitor.names import shorten
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
from bayessim_mjx.monitor.style import handles, head, heading, new_figure, size_of
from bayessim_mjx.quantities import compact, fixed

__all__ = ["corner", "pair", "predictive"]

FULL_CORNER = 12  # up to so many parameters every pair is drawn


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
