"""Colours, figures and legends that all plots share.

Posterior blue, prior green and dashed, truth red: BayesSimIG's colours, in shades that colour-blind eyes tell apart.
"""

from collections.abc import Sequence
from typing import Any

from bayessim_mjx.monitor.tables import shorten

BLUE, GREEN, RED, YELLOW, GREY, NAVY, SKY = "#0072B2", "#009E73", "#D1350F", "#F5D000", "#6B6B6B", "#003B5C", "#9CCBE8"
DASHED = (0, (4, 2))
DPI = 120


def new_figure(width: float, height: float, layout: str | None = None) -> Any:
    """Make a white Figure of width x height inches that belongs to nobody (no pyplot)."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), dpi=DPI, facecolor="white", layout=layout)  # type: ignore[arg-type]
    FigureCanvasAgg(figure)
    return figure


def size_of(figure: Any) -> tuple[float, float]:
    """Width and height in inches of a Figure or SubFigure."""
    return figure.bbox.width / DPI, figure.bbox.height / DPI


def blues() -> Any:
    """Colours from white to blue, for densities."""
    from matplotlib.colors import LinearSegmentedColormap

    return LinearSegmentedColormap.from_list("posterior", ["#FFFFFF", SKY, BLUE])


def handles(items: Sequence[str], truth_label: str = "truth") -> tuple[list[Any], list[str]]:
    """Legend handles and texts of the things named."""
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    known = {
        "posterior": (Line2D([], [], color=BLUE, lw=2), "posterior"),
        "prior": (Line2D([], [], color=GREEN, lw=1.5, ls=DASHED), "prior"),
        "truth": (Line2D([], [], color=RED, lw=2), truth_label),
        "regions": (Patch(fc=SKY, ec=BLUE), "50 and 90 % regions"),
        "star": (Line2D([], [], color=YELLOW, marker="*", mec="black", ls="", ms=11), "truth of both"),
        "means": (Line2D([], [], color=NAVY, marker="+", ls="", ms=8, mew=1.6), "component means"),
        "real": (Line2D([], [], color="black", lw=1.5), "real"),
        "draw": (Line2D([], [], color=BLUE, lw=0.8), "single simulations"),
        "band90": (Patch(fc=BLUE, alpha=0.18), "90 % of simulations"),
        "band50": (Patch(fc=BLUE, alpha=0.5), "50 %"),
        "before": (Patch(fc=GREEN, alpha=0.2), "90 % under the prior"),
    }
    return [known[i][0] for i in items], [known[i][1] for i in items]


def head(figure: Any, heading: str, items: Sequence[str], truth_label: str = "truth") -> None:
    """Title and one-row legend in the top 0.5 inches of the figure."""
    marks, texts = handles(items, truth_label)
    width, height = size_of(figure)
    title = shorten([heading], int(width * 9), 1)[0]
    figure.text(0.5, 1 - 0.12 / height, title, fontsize=11, ha="center", va="top")
    style: dict[str, Any] = dict(frameon=False, fontsize=8, columnspacing=1.2, handlelength=1.6)
    above = (0.5, 1 - 0.26 / height)
    figure.legend(marks, texts, ncols=len(items), loc="upper center", bbox_to_anchor=above, **style)


def heading(what: str, round: int | None) -> str:
    """`Round 3: posterior`."""
    return what if round is None else f"Round {round}: {what}"
