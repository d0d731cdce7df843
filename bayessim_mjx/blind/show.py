"""A blind check for people: the terminal, TensorBoard, and one page that needs nothing else."""

import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from markupsafe import Markup

from bayessim_mjx.blind.amounts import AMOUNTS, OTHER, spoken
from bayessim_mjx.blind.recall import PAGE
from bayessim_mjx.monitor.style import BLUE, GREY, SKY, blues, new_figure
from bayessim_mjx.monitor.writer import TensorBoard
from bayessim_mjx.quantities import MISSING, count, duration, finite, percent

Found = Mapping[str, Any]
TEMPLATE = "page.html.j2"
RATES = (
    ("found", "hidden effects named at their place"),
    ("in_the_set", "named, or among the rivals of the named effect"),
    ("false_alarms", "false alarms where nothing is hidden"),
    ("unknown_unexplained", "unknown causes called unexplained"),
    ("coverage", "90 % intervals that hold the truth"),
)


def share(rate: Mapping[str, float]) -> tuple[str, str, str]:
    """(rate, its 95 % interval, of how many)."""
    n = int(rate["n"])
    if not n:
        return MISSING, MISSING, "0"
    return percent(rate["hits"] / n), f"{percent(rate['low'])} to {percent(rate['high'])}", str(n)


def thresholds(found: Found) -> tuple[list[str], list[list[str]]]:
    """Header and rows: what was tried, the clearest threshold first within each effect."""
    rows = []
    for r in found["thresholds"]:
        if not r["tried"]:
            continue
        wrong = found["mistaken"].get(r["effect"], {})
        said = ", ".join(f"{spoken(k)} {n}" for k, n in list(wrong.items())[:3])
        what = AMOUNTS.get(r["effect"], OTHER).what
        rows.append(
            [title(r["effect"], r["where"]), what, r["told"], r["interval"], f"{r['found']}/{r['tried']}", said]
        )
    return ["effect", "in", "found 9 of 10 from", "90 % interval", "found", "else said (all places)"], rows


def rates(found: Found) -> tuple[list[str], list[list[str]]]:
    rows = [[words, *share(found[key])] for key, words in RATES]
    closed = found["closure"]
    if closed["n"]:
        between = f"{percent(closed['low'])} to {percent(closed['high'])}"
        rows.append(["gap closed by rightly named effects, median and 90 % range", percent(closed["median"]), between,
                     str(closed["n"])])  # fmt: skip
    if (real := found.get("really_closed")) and real["n"]:
        between = f"{percent(real['low'])} to {percent(real['high'])}"
        rows.append(
            ["of that in the finer reality itself, without noise", percent(real["median"]), between, str(real["n"])]
        )
    return ["", "share", "interval", "n"], rows


def console(found: Found, folder: Path, out: Any) -> None:
    """Print the answer; `out`: a `monitor.Console`."""
    out.panel("blind check", [(headline(found), "bold"), *((s, "") for s in found["sentences"])], "blue")
    header, rows = thresholds(found)
    if rows:
        out.grid(header, rows, left=(0, 1, 5))
    header, rows = rates(found)
    out.grid(header, rows)
    header, rows = lookalikes(found)
    if rows:
        out.grid(header, rows, "similar effects that these experiments do not separate", left=(0, 1, 3))
    out.say(str(folder / PAGE))


def headline(found: Found) -> str:
    """How many cases, how long each took, and the two rates that matter most."""
    if not found["cases"]:
        return "No case is finished yet."
    said = f"{count(found['cases'], 'blind case')}, {duration(found['seconds'])} each"
    hits, n = found["found"]["hits"], found["found"]["n"]
    alarms, nulls = found["false_alarms"]["hits"], found["false_alarms"]["n"]
    return f"{said}: {hits} of {n} hidden effects named at their place, {alarms} of {nulls} false alarms"


def lookalikes(found: Found) -> tuple[list[str], list[list[str]]]:
    """Pairs that these experiments leave together, and the motion that would part them."""
    rows = []
    for p in found.get("lookalikes", ()):
        best = f"{p['excitation']} ({p['by']:.1f} noises)" if p["excitation"] else "none of the menu"
        pair = [title(p["hidden"], p["where"]), title(p["rival"], p["rival_where"])]
        rows.append([*pair, f"{p['left']:.2f}", best])
    return ["hidden", "explained as well by", "noises between them", "separated by"], rows


def untried(found: Found) -> list[str]:
    """`coulomb friction: waist, shoulder`: where each effect was not hidden yet."""
    rows = [r for r in found["thresholds"] if not r["tried"]]
    effects = dict.fromkeys(r["effect"] for r in rows)
    places = {e: [r["where"] for r in rows if r["effect"] == e and r["where"] not in ("", "world")] for e in effects}
    return [f"{spoken(e)}: {', '.join(where)}" if where else spoken(e) for e, where in places.items()]


def tensorboard(found: Found, folder: Path) -> None:
    """Scalars, pictures and the answer as text, as event files in `folder`; step: the number of cases."""
    step = int(found["cases"])
    with TensorBoard(folder) as writer:
        scalars = {f"Blind/{key}": found[key]["hits"] / found[key]["n"] for key, _ in RATES if found[key]["n"]}
        for r in found["thresholds"]:
            if r["tried"] and r["amount"] and finite(r["amount"][0]):
                scalars[f"Blind found 9 of 10 (noises)/{r['effect']}@{r['where']}"] = r["strength"][0]
        writer.scalars(step, scalars)
        writer.text("Blind/answer", "\n\n".join([f"**{headline(found)}**", *found["sentences"]]))
        for tag, figure in pictures(found).items():
            writer.figure(f"Blind/{tag}", figure, step)


def page(found: Found, about: Sequence[str], folder: Path) -> Path:
    """Write the page; returns its path."""
    from jinja2 import Environment, FileSystemLoader, StrictUndefined

    here = Path(__file__).parent
    folders = [here, here.with_name("report")]  # the report's has styles and scripts of both
    environment = Environment(
        loader=FileSystemLoader(folders), autoescape=True, undefined=StrictUndefined, trim_blocks=True,
        lstrip_blocks=True,
    )  # fmt: skip
    text = environment.get_template(TEMPLATE).render(
        headline=headline(found), about=about, sentences=found["sentences"], thresholds=thresholds(found),
        looked=found.get("looked", True), rates=rates(found), lookalikes=lookalikes(found),
        versions=found.get("versions", {}),
        pictures={tag: Markup(svg(figure)) for tag, figure in pictures(found).items()},
        untried=untried(found),
    )  # fmt: skip
    path = folder / PAGE
    path.write_text(text, encoding="utf-8")
    return path


# Pictures of a blind check, for its page and for TensorBoard: found and missed cases, detection curves, confusion


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
