"""A diagnosis on the terminal: the verdict, the effects, the best candidates, the warnings and where the files are."""

from pathlib import Path
from typing import TextIO

from bayessim_mjx.diagnosis.result import Diagnosis, FoundEffect
from bayessim_mjx.monitor.console import Console
from bayessim_mjx.monitor.tables import TIE
from bayessim_mjx.report.words import (
    MISSING,
    between,
    candidate_title,
    closure,
    effect_title,
    estimate,
    finite,
    headline,
    not_fitted,
    number,
    percent,
    quantity,
    stages_of,
    stages_told,
    verdict_of,
)

BEST = 8
NOT_FITTED = 6  # named for each reason; diagnosis.json has all
Table = tuple[list[str], list[list[str]], tuple[int, ...]]  # header, rows, columns of words
COLOURS = {
    "no_gap": "green",
    "parameters": "blue",
    "noise": "blue",
    "effects": "blue",
    "ambiguous": "yellow",
    "unexplained": "red",
    "insufficient_data": "white",
}
FILES = ("report.html", "diagnosis.json", "effects.yaml", "model_with_effects.xml")


def console(
    diagnosis: Diagnosis, folder: str | Path | None = None, *, file: TextIO | None = None, headless: bool = False
) -> None:
    """Print the diagnosis.

    Args:
        folder: where its files were written; those that are there are named.
        file: where to; None: standard output.
        headless: no control characters, as where there is no terminal.
    """
    with Console(file=file, headless=headless) as out:
        out.panel(verdict_of(diagnosis).badge, _verdict(diagnosis), COLOURS[diagnosis.verdict])
        for table in (_effects, _parameters, _places, _candidates):
            header, rows, words = table(diagnosis)
            if rows:
                out.grid(header, rows, left=words)
        if len(diagnosis.candidates) > BEST:
            out.say(f"{len(diagnosis.candidates) - BEST} more candidates in diagnosis.json")
        for line in not_fitted(diagnosis, NOT_FITTED):
            out.say(f"not fitted, {line}")
        if plan := diagnosis.next_experiment:
            name, why = plan.get("name", MISSING), plan.get("why", "")
            text = why if name in why or name == "none" else f"{name}: {why}"
            out.say(f"next experiment: {text}" + (f" ({plan['file']})" if plan.get("file") else ""))
        for warning in diagnosis.warnings:
            out.warning(warning)
        for path in (Path(folder) / name for name in FILES) if folder is not None else ():
            if path.exists():
                out.say(str(path))


def _verdict(d: Diagnosis) -> list[tuple[str, str]]:
    """Lines of (text, style)."""
    known = [f"{stages_told(d)[s]} {number(v)}" for s, v in stages_of(d).items() if finite(v) and s in stages_told(d)]
    lines = [(headline(d), "bold"), *((sentence, "") for sentence in d.sentences[1:])]
    if known:
        lines.append(("gap in noise standard deviations: " + ", ".join(known), ""))
    lines += [(line, "") for line in _longest(d)]
    return [*lines, (verdict_of(d).advice, "dim")]


def _longest(d: Diagnosis) -> list[str]:
    """The gap over the longest horizon, where that is not the one of the line before."""
    last = d.gap.horizons[-1] if d.gap.horizons else {}
    if not last or last.get("nominal") == d.gap.nominal:
        return []
    known = [f"{words} {number(last[s])}" for s, words in stages_told(d).items() if finite(last.get(s))]
    return [f"{last['name']} ({number(last.get('seconds'), 2)} s): " + ", ".join(known)]


def _effects(d: Diagnosis) -> Table:
    header = ["effect", "parameters", "gap closed", "90 %", "predicted", "score among rivals"]
    rows = []
    for e in d.effects:
        found = [quantity(k, v) for k, v in e.parameters.items()]
        rows.append(
            [
                effect_title(e.name, e.where),
                ", ".join(f"{k} {v.replace(' ', TIE)}" for k, v in found),  # a number keeps its unit
                percent(e.gap_closed),
                between(*e.gap_closed_ci),
                percent(e.predicted_gap_closed),
                _rivals(e),
            ]
        )
    if not any(row[-1] for row in rows):
        header, rows = header[:-1], [row[:-1] for row in rows]
    return header, rows, (0, 1, 5)


def _rivals(e: FoundEffect) -> str:
    """The effect's relative score and then its rivals with theirs, where they have one; nothing where there is none."""
    shares = [percent(e.weight_among_rivals)] if finite(e.weight_among_rivals) else []
    rivals = [(candidate_title(r), r.get("weight")) for r in e.equivalent_to]
    return "; ".join([*shares, *(f"{name} {percent(weight)}" if finite(weight) else name for name, weight in rivals)])


def _parameters(d: Diagnosis) -> Table:
    """What the simulator's own parameters become, where that is the whole answer."""
    rows = [
        [name, number(p.get("nominal")), estimate(p.get("mean"), p.get("sd"), p.get("unit") or "")]
        for name, p in d.parameters.items()
        if d.verdict in ("parameters", "noise")
    ]
    return ["parameter", "as delivered", "recalibrated"], rows, (0,)


def _places(d: Diagnosis) -> Table:
    """Where the gap lies, where no effect says so."""
    rows = [[p.channel, percent(p.share), between(*p.ci), p.region] for p in d.where if d.verdict == "unexplained"]
    return ["where the gap lies", "share", "90 %", "region"], rows, (0, 3)


def _candidates(d: Diagnosis) -> Table:
    rows = []
    for k, c in enumerate(d.candidates[:BEST], 1):
        se = number(c.get("se")) if finite(c.get("se")) else MISSING
        rows.append([f"{k} {candidate_title(c)}", number(c.get("score")), se, closure(c.get("gap_closed"))])
    return ["candidate", "held-out score", "standard error", "gap closed"], rows, (0,)
