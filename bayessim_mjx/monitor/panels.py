"""The panels that plots of a posterior are made of: marginals, joint densities, intervals, correlations."""

from typing import Any

import numpy as np

from bayessim_mjx.monitor.draws import Draws, density, density2, levels
from bayessim_mjx.monitor.style import BLUE, DASHED, GREEN, GREY, NAVY, RED, YELLOW, blues, size_of
from bayessim_mjx.monitor.tables import shorten
from bayessim_mjx.quantities import compact, fixed, spread

Limits = tuple[float, float]
NARROWEST = 1e-4  # of the prior range: no axis is narrower, as its ticks would have too many digits
NEAR = 0.05  # of the prior range: an axis that ends so close to it goes on to it


def triangle(figure: Any, draws: Draws, true: np.ndarray | None, top: float = 0.75) -> None:
    """Fill a (sub)figure with marginals on the diagonal and joint densities below; `top` inches stay free above."""
    d = draws.d
    width, height = size_of(figure)
    left, right, bottom = 0.95 if d > 1 else 0.4, 0.25, 0.85 if d > 1 else 0.6
    box = dict(left=left / width, right=1 - right / width, bottom=bottom / height, top=1 - top / height)
    grid = figure.subplots(d, d, squeeze=False, gridspec_kw=box | dict(hspace=0.16, wspace=0.12))
    cell = ((width - left - right) / d, (height - bottom - top) / d)
    size = 9.0 if d == 1 else 7.5 if cell[0] > 1.5 else 6.5 if cell[0] > 1.0 else 5.5
    limits = [limits_of(draws, k, true) for k in range(d)]
    for row in range(d):
        for column in range(d):
            axes = grid[row, column]
            if column > row:
                corner = axes.get_position()
                axes.remove()
                if d == 2:
                    facts(figure, (corner.x0 + 0.02, corner.y1 - 0.02), draws, true)
                continue
            if column == row:
                marginal(axes, draws, row, true, limits[row])
                axes.set_title(median_in_words(draws, row), fontsize=size, pad=3)
            else:
                joint(axes, draws, (column, row), true, (*limits[column], *limits[row]))
            axes.tick_params(labelsize=size - 0.5, length=2, pad=1.5)
            axes.tick_params(labelbottom=row == d - 1, labelleft=column == 0 and row > 0)
            few_ticks(axes, draws, (column, row), cell)
    _name_edges(grid, draws, cell, size, [zoomed(draws, k, limits[k]) for k in range(d)])


def _name_edges(grid: Any, draws: Draws, cell: tuple[float, float], size: float, part: list[bool]) -> None:
    """Names along the left and the bottom, in as many characters as a cell has room for.

    Below an axis that shows a `part` of the prior range only, the range stands in full.
    """
    d = draws.d
    per_inch = 72 / (size * 0.64)
    room = [max(8, int(side * 0.97 * per_inch)) for side in cell]
    for k in range(d):
        below = grid[d - 1, k]
        name = label(draws, k, room[0] if d > 1 else 60, 3)
        below.set_xlabel(name + (f"\nprior {prior_range(draws, k)}" if part[k] else ""), fontsize=size)
        below.xaxis.set_label_coords(0.5, -(0.22 if d > 1 else 0.28) / cell[1])
        if k > 0:
            grid[k, 0].set_ylabel(label(draws, k, room[1], 3), fontsize=size)
            grid[k, 0].yaxis.set_label_coords(-0.48 / cell[0], 0.5)


def facts(figure: Any, corner: tuple[float, float], draws: Draws, true: np.ndarray | None) -> None:
    """Write numbers that no title has into the empty cell of two parameters, from its upper left corner on."""
    lines = [f"correlation   {fixed(draws.numbers.correlation[0, 1], 2)}", "", "posterior/prior sd"]
    lines += [f"    {n}   {w:.2g}" for n, w in zip(shorten(draws.names, 24), draws.numbers.width, strict=True)]
    if true is not None:
        values = [compact(natural(draws, k, true[k])) for k in range(draws.d)]
        lines += ["", "truth", *(f"    {n}   {v}" for n, v in zip(shorten(draws.names, 24), values, strict=True))]
    figure.text(*corner, "\n".join(lines), va="top", fontsize=7.5, linespacing=1.5)


def marginal(axes: Any, draws: Draws, k: int, true: np.ndarray | None, limits: Limits) -> None:
    """Density of parameter k over its prior, with the truth."""
    x, y = density(draws.values[:, k], *limits)
    axes.fill_between(x, y, color=BLUE, alpha=0.25, lw=0)
    axes.plot(x, y, color=BLUE, lw=1.4)
    if draws.prior is None:
        flat = 1.0 / (draws.high[k] - draws.low[k])
        axes.plot(np.clip([draws.low[k], draws.high[k]], *limits), [flat, flat], color=GREEN, lw=1.3, ls=DASHED)
    else:
        axes.plot(*density(draws.prior[:, k], draws.low[k], draws.high[k]), color=GREEN, lw=1.3, ls=DASHED)
    if true is not None:
        axes.axvline(true[k], color=RED, lw=1.6)
    axes.set_xlim(*limits)
    axes.set_ylim(0, 1.12 * y.max())
    axes.set_yticks([])
    _numbers(axes.xaxis, draws.log[k])


def joint(axes: Any, draws: Draws, ij: tuple[int, int], true: np.ndarray | None, box: Any, star: bool = False) -> None:
    """Density of parameters i (across) and j (up) in box (low i, high i, low j, high j), with 50 and 90 % regions.

    `star` is BayesSimIG's look: smooth, a yellow star at the truth, a + at each component's mean.
    """
    i, j = ij
    x, y, height = density2(draws.values[:, i], draws.values[:, j], box, 100)
    flat = 1.0 / height.size
    top = max(height.max(), 2.5 * flat)
    axes.imshow(
        height, extent=box, origin="lower", aspect="auto", interpolation="bicubic", cmap=blues(), vmin=0, vmax=top
    )
    if height.max() > 1.8 * flat:  # contours of a flat density would only draw its noise
        lines = levels(height, (0.9, 0.5))
        axes.contour(x, y, height, levels=lines, colors=BLUE, linewidths=[0.8, 1.3][-len(lines) :])
    if star and draws.means is not None:
        axes.plot(draws.means[:, i], draws.means[:, j], "+", color=NAVY, ms=9, mew=1.6)
    if true is not None and star:
        axes.plot(true[i], true[j], "*", color=YELLOW, mec="black", mew=0.8, ms=15, zorder=5)
    elif true is not None:
        axes.axvline(true[i], color=RED, lw=0.8, alpha=0.8)
        axes.axhline(true[j], color=RED, lw=0.8, alpha=0.8)
        axes.plot(true[i], true[j], "o", color=RED, ms=3.5)
    axes.set_xlim(box[0], box[1])
    axes.set_ylim(box[2], box[3])
    _numbers(axes.xaxis, draws.log[i])
    _numbers(axes.yaxis, draws.log[j])


def intervals(axes: Any, draws: Draws, true: np.ndarray | None, room: int = 46) -> None:
    """50 and 95 % intervals as fractions of the prior range; the best identified on top, their widths at the right."""
    width, order = draws.numbers.width, best_first(draws)
    unit = (np.percentile(draws.values, [2.5, 25, 50, 75, 97.5], axis=0) - draws.low) / (draws.high - draws.low)
    for place, k in enumerate(order):
        axes.plot(unit[[0, 4], k], [place, place], color=BLUE, lw=1.4, alpha=0.55, solid_capstyle="butt")
        axes.plot(unit[[1, 3], k], [place, place], color=BLUE, lw=5.0, solid_capstyle="butt")
        axes.plot(unit[2, k], place, "|", color="white", ms=6, mew=1.4)
        axes.text(1.03, place, f"{width[k]:.2g}", va="center", fontsize=7, color=GREY)
    if true is not None:
        at = (true - draws.low) / (draws.high - draws.low)
        axes.plot(np.clip(at[order], 0, 1), np.arange(draws.d), "d", color=RED, ms=4.5, clip_on=False, zorder=5)
    axes.set_yticks(range(draws.d), [label(draws, k, room, 1, ranges=True) for k in order], fontsize=7)
    axes.set_ylim(draws.d - 0.4, -0.6)
    axes.set_xlim(0, 1)
    axes.set_xticks([0, 0.25, 0.5, 0.75, 1], ["low", "25 %", "50 %", "75 %", "high"], fontsize=7.5)
    axes.set_xlabel("place in the prior range", fontsize=8)
    axes.text(1.03, -0.75, "posterior /\nprior sd", fontsize=7, color=GREY, va="bottom", ha="left")
    axes.set_title("50 % and 95 % intervals, best identified first", fontsize=9, loc="left")
    axes.grid(axis="x", color="#E5E5E5", lw=0.7)
    axes.set_axisbelow(True)
    axes.spines[["top", "right", "left"]].set_visible(False)
    axes.tick_params(axis="y", length=0)


def correlation(figure: Any, draws: Draws) -> None:
    """Heat map of the correlations, the best identified parameters first."""
    ranked = draws.pick(best_first(draws))
    width, height = size_of(figure)
    side = min(height - 1.05, width - 3.5)
    axes = figure.add_axes((2.3 / width, 0.7 / height, side / width, side / height))
    picture = axes.imshow(ranked.numbers.correlation, vmin=-1, vmax=1, cmap="RdBu_r", interpolation="nearest")
    step = max(1, int(np.ceil(ranked.d * 6.5 / (side * 72))))
    ticks, short = range(0, ranked.d, step), shorten(ranked.names, 30)
    size = float(np.clip(side * 72 / ranked.d * 0.85 * step, 4.5, 7))
    axes.set_yticks(ticks, [f"{short[k]}  {k + 1}" for k in ticks], fontsize=size)
    axes.set_xticks(ticks, [str(k + 1) for k in ticks], fontsize=size, rotation=90 if ranked.d > 25 else 0)
    axes.tick_params(length=1.5, pad=1.5)
    axes.set_title("correlation under the posterior, best identified first", fontsize=9)
    bar = figure.add_axes(((2.45 + side) / width, 0.7 / height, 0.02, side / height))
    figure.colorbar(picture, cax=bar).ax.tick_params(labelsize=7)


def best_first(draws: Draws) -> np.ndarray:
    """Parameters [d] by sd over that of the prior, best identified first."""
    return np.argsort(draws.numbers.width, kind="stable")


def limits_of(draws: Draws, k: int, true: np.ndarray | None) -> Limits:
    """Where parameter k is drawn: the central 98 % of the posterior and half as much on either side, and the truth.

    Never beyond the prior range, but for a truth outside of it. A posterior as wide as the prior is drawn over all of
    it; every narrower one fills the same part of its axis, so that no parameter is squeezed.
    """
    low, high = float(draws.low[k]), float(draws.high[k])
    inner = [float(v) for v in np.percentile(draws.values[:, k], [1.0, 99.0])]
    margin = 0.5 * max(inner[1] - inner[0], NARROWEST * (high - low))
    left, right = max(inner[0] - margin, min(low, inner[0])), min(inner[1] + margin, max(high, inner[1]))
    if true is not None:
        gap = 0.05 * (right - left)  # the line is not to lie on the frame
        left = min(left, max(true[k] - gap, min(low, true[k])))
        right = max(right, min(true[k] + gap, max(high, true[k])))
    whole = high - low
    return (low if 0 < left - low < NEAR * whole else left), (high if 0 < high - right < NEAR * whole else right)


def zoomed(draws: Draws, k: int, limits: Limits) -> bool:
    """Whether a part of the prior range lies outside."""
    return limits[0] > draws.low[k] or limits[1] < draws.high[k]


def label(draws: Draws, k: int, width: int, lines: int, ranges: bool = False) -> str:
    """Name and unit of parameter k (and its range) in `lines` lines of `width` characters."""
    tail = f" [{draws.units[k]}]" if draws.units[k] else ""
    if ranges:
        tail += f"   {prior_range(draws, k)}"
    if lines == 1:
        return shorten(draws.names, max(width - len(tail), 8))[k] + tail
    name = shorten(draws.names, width, lines - bool(tail))[k]
    apart = len(name.rsplit("\n", 1)[-1] + tail) > width
    return name + ("\n" + tail.strip() if apart else tail)


def prior_range(draws: Draws, k: int) -> str:
    """`0.5 to 2`, in the parameter's own unit."""
    return " to ".join(compact(natural(draws, k, end[k]), 3) for end in (draws.low, draws.high))


def median_in_words(draws: Draws, k: int) -> str:
    """`1.04 ± 0.06`, or median and 68 % interval, in the parameter's own unit."""
    n = draws.numbers
    return spread(n.median[k], n.low[k], n.high[k], n.sd[k])


def natural(draws: Draws, k: int, value: Any) -> Any:
    """Convert a plotting coordinate to the parameter's own unit."""
    return 10.0**value if draws.log[k] else value


def _numbers(axis: Any, log: bool) -> None:
    from matplotlib.ticker import FuncFormatter

    if log:
        axis.set_major_formatter(FuncFormatter(lambda v, _: f"{10.0**v:.2g}"))


def few_ticks(axes: Any, draws: Draws, place: tuple[int, int], cell: tuple[float, float]) -> None:
    """As many ticks as a cell of these inches has room for; `place`: the parameters across and up."""
    from matplotlib.ticker import MaxNLocator

    most = [6 if side > 3 else 4 if side > 2 else 3 if side > 1.0 else 2 for side in cell]
    sides = [(axes.xaxis, place[0], most[0])] + [(axes.yaxis, place[1], most[1])] * (place[0] != place[1])
    for axis, k, count in sides:
        axis.set_major_locator(MaxNLocator(count, prune="both" if draws.d > 1 else None))
        _numbers(axis, draws.log[k])
