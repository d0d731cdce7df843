"""A blind check for people: the terminal, TensorBoard, and one page that needs nothing else."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from markupsafe import Markup

from bayessim_mjx.blind.amounts import AMOUNTS, OTHER, spoken
from bayessim_mjx.blind.figures import pictures, svg, title
from bayessim_mjx.blind.recall import PAGE
from bayessim_mjx.monitor.writer import TensorBoard
from bayessim_mjx.quantities import MISSING, count, duration, finite, percent

Found = Mapping[str, Any]
TEMPLATE = "page.html.j2"
RATES = (
    ("found", "hidden effects named at their place"),
    ("in_the_set", "named, or among the rivals of what is named"),
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
        out.grid(header, rows, "look-alikes that these experiments do not separate", left=(0, 1, 3))
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
    return ["hidden", "explained as well by", "noises between them", "told apart by"], rows


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

    environment = Environment(
        loader=FileSystemLoader(Path(__file__).parent), autoescape=True, undefined=StrictUndefined, trim_blocks=True,
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
