"""A diagnosis on the terminal: verdict, effects, gap, a command and warnings first; then tables and sentences."""

from collections.abc import Callable
from pathlib import Path
from typing import TextIO

from bayessim_mjx.diagnosis.phrases.advice import command, headline, purpose, verdict_of
from bayessim_mjx.diagnosis.phrases.effects import candidate_title, capital, titled
from bayessim_mjx.diagnosis.phrases.residual import parted
from bayessim_mjx.diagnosis.phrases.size import gap_line
from bayessim_mjx.diagnosis.phrases.verdict import counts_as_answer
from bayessim_mjx.diagnosis.result import Diagnosis, FoundEffect
from bayessim_mjx.monitor.console import Console
from bayessim_mjx.monitor.tables import TIE
from bayessim_mjx.quantities import finite
from bayessim_mjx.report.look import TONES
from bayessim_mjx.report.words import MISSING, between, closure, estimate, not_fitted, number, percent, quantity, signs

BEST = 8  # candidates; no source: a matter of style
NOT_FITTED = 6  # named for each reason; diagnosis.json has all; no source: a matter of style
Table = tuple[list[str], list[list[str]], tuple[int, ...]]  # header, rows, columns of words
FILES = ("report.html", "diagnosis.json", "effects.yaml", "model_with_effects.xml", "model_with_effects.urdf")


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
        out.panel(verdict_of(diagnosis).badge, _first(diagnosis), TONES[diagnosis.verdict][0])
        if folder is not None and (text := command(diagnosis, folder)):
            out.command(purpose(text), text)
        for warning in diagnosis.warnings:
            out.warning(signs(warning))
        _tables(out, diagnosis, (_effects, _parameters))
        if diagnosis.effects and (diagnosis.details.get("before_simulation") or {}).get("lines"):
            out.say("these numbers replace the first guesses")
        for sentence in parted(diagnosis)[0]:
            out.say(f"- {signs(sentence)}")
        _tables(out, diagnosis, (_places,))
        if diagnosis.verdict != "no_gap":  # shares of a gap that is noise say nothing
            _ranking(out, diagnosis)
        if plan := diagnosis.next_experiment:
            name, why = plan.get("name", MISSING), plan.get("why", "")
            text = why if name in why or name == "none" else f"{name}: {why}"
            out.say(f"next experiment: {text}" + (f" ({plan['file']})" if plan.get("file") else ""))
        for path in (Path(folder) / name for name in FILES) if folder is not None else ():
            if path.exists():
                out.say(str(path))


def _ranking(out: Console, diagnosis: Diagnosis) -> None:
    """Print the best candidates with the verdict, and what was not fitted."""
    _tables(out, diagnosis, (_candidates,))
    if len(diagnosis.candidates) > BEST:
        out.say(f"all {len(diagnosis.candidates)} candidates: diagnosis.json")
    for line in not_fitted(diagnosis, NOT_FITTED):
        out.say(f"not fitted, {line}")


def _tables(out: Console, d: Diagnosis, tables: tuple[Callable[[Diagnosis], Table], ...]) -> None:
    for table in tables:
        header, rows, words = table(d)
        if rows:
            out.grid(header, rows, left=words)


def _first(d: Diagnosis) -> list[tuple[str, str]]:
    """Lines of (text, style) that a person sees first; the same order as on the page."""
    lines = [(headline(d), "bold"), (gap_line(d), ""), (verdict_of(d).advice, "dim")]
    return [(signs(text), style) for text, style in lines if text]


def _effects(d: Diagnosis) -> Table:
    closed = "gap closed" if len(d.effects) == 1 else "part of the gap closed"
    header = ["effect", "parameters", closed, "90 % interval", "predicted", "score among rivals"]
    rows = []
    for e in d.effects:
        found = [quantity(k, v, e.name) for k, v in e.parameters.items()]
        rows.append(
            [
                capital(titled(e.name, e.where)),
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
    """Return the effect's relative score, then its rivals with theirs, where they have one; "" without rivals."""
    shares = [percent(e.weight_among_rivals)] if finite(e.weight_among_rivals) else []
    rivals = [(candidate_title(r), r.get("weight")) for r in e.equivalent_to]
    return "; ".join([*shares, *(f"{name} {percent(weight)}" if finite(weight) else name for name, weight in rivals)])


def _parameters(d: Diagnosis) -> Table:
    """Tabulate the simulator's own parameters, where they are the whole answer."""
    rows = [
        [name, number(p.get("nominal")), estimate(p.get("mean"), p.get("sd"), p.get("unit") or "")]
        for name, p in d.parameters.items()
        if d.verdict in ("parameters", "noise")
    ]
    return ["parameter", "as delivered", "recalibrated"], rows, (0,)


def _places(d: Diagnosis) -> Table:
    """Where the gap lies, where no effect says so."""
    several = d.where if d.verdict == "unexplained" and len(d.where) > 1 else []
    rows = [[p.channel, percent(p.share), between(*p.ci), p.region] for p in several]
    return ["where the gap lies", "share", "90 % interval", "region"], rows, (0, 3)


def _candidates(d: Diagnosis) -> Table:
    rows, answer = [], d.rank
    for k, c in enumerate(d.candidates, 1):
        if k <= BEST or k == answer:
            se = number(c.get("se")) if finite(c.get("se")) else MISSING
            mark = ", the verdict" if k == answer else ", counts as the verdict" if counts_as_answer(d, c) else ""
            rows.append([f"{k} {candidate_title(c)}{mark}", number(c.get("score")), se, closure(c.get("gap_closed"))])
    return ["candidates", "held-out score (nats)", "standard error", "gap closed by the set"], rows, (0,)
