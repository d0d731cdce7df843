"""A diagnosis on the terminal: the verdict, the effects, the best candidates, the warnings and where the files are."""

import sys
from pathlib import Path
from typing import Any, TextIO

from bayessim_mjx.diagnosis.result import Diagnosis
from bayessim_mjx.monitor.console import FILE_WIDTH
from bayessim_mjx.monitor.words import ascii_of
from bayessim_mjx.report.sections import between, stages_of
from bayessim_mjx.report.words import (
    MISSING,
    STAGES,
    VERDICTS,
    candidate_title,
    effect_title,
    finite,
    headline,
    number,
    percent,
    quantity,
)

BEST = 8
COLOURS = {
    "no_gap": "green",
    "parameters": "blue",
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
    from rich.console import Console
    from rich.text import Text

    file = file or sys.stdout
    live = not headless and bool(getattr(file, "isatty", lambda: False)())
    options: dict[str, Any] = {} if live else dict(force_terminal=False, no_color=True, width=FILE_WIDTH)
    unicode = "utf" in (getattr(file, "encoding", None) or "utf-8").lower()
    rich = Console(file=file, highlight=False, **options)

    def text(words: Any, style: str = "") -> Text:
        return Text(str(words) if unicode else ascii_of(str(words)), style)

    rich.print(_verdict(diagnosis, text, unicode))
    for table in (_effects(diagnosis, text), _candidates(diagnosis, text)):
        if table is not None:
            rich.print(table)
    for warning in diagnosis.warnings:
        rich.print(text(f"warning: {warning}", "yellow"), soft_wrap=True)
    for path in (Path(folder) / name for name in FILES) if folder is not None else ():
        if path.exists():
            rich.print(text(path), soft_wrap=True)


def _verdict(d: Diagnosis, text: Any, unicode: bool) -> Any:
    from rich import box
    from rich.console import Group
    from rich.panel import Panel

    known = [f"{STAGES[s]} {number(v)}" for s, v in stages_of(d).items() if finite(v)]
    lines = [text(headline(d), "bold"), *map(text, d.sentences[1:])]
    if known:
        lines.append(text("gap in noise standard deviations: " + ", ".join(known)))
    lines += [text(line) for line in _longest(d)]
    lines.append(text(VERDICTS[d.verdict].advice, "dim"))
    style = COLOURS[d.verdict]
    edge = box.ROUNDED if unicode else box.ASCII
    return Panel(
        Group(*lines),
        title=text(VERDICTS[d.verdict].badge, f"bold {style}"),
        title_align="left",
        border_style=style,
        box=edge,
    )


def _longest(d: Diagnosis) -> list[str]:
    """The gap over the longest horizon, where that is not the one of the line before."""
    last = d.gap.horizons[-1] if d.gap.horizons else {}
    if not last or last.get("nominal") == d.gap.nominal:
        return []
    known = [f"{STAGES[s]} {number(last[s])}" for s in STAGES if finite(last.get(s))]
    return [f"{last['name']} ({number(last.get('seconds'), 2)} s): " + ", ".join(known)]


def _table(*columns: tuple[str, bool]) -> Any:
    from rich.table import Table

    table = Table(box=None, pad_edge=False, header_style="bold", padding=(0, 2, 0, 0))
    for words, right in columns:
        table.add_column(words, justify="right" if right else "left")
    return table


def _effects(d: Diagnosis, text: Any) -> Any:
    if not d.effects:
        return None
    table = _table(
        ("effect", False),
        ("parameters", False),
        ("gap closed", True),
        ("90 %", True),
        ("promised", True),
        ("probability", True),
        ("or", False),
    )
    for e in d.effects:
        found = [quantity(k, v) for k, v in e.parameters.items()]
        rivals = "; ".join(candidate_title(r) for r in e.equivalent_to)
        values = ", ".join(f"{k} {v}" for k, v in found)
        cells = (
            effect_title(e.name, e.where),
            values,
            percent(e.gap_closed),
            between(*e.gap_closed_ci),
            percent(e.predicted_gap_closed),
            percent(e.probability),
            rivals,
        )
        table.add_row(*map(text, cells))
    return table


def _candidates(d: Diagnosis, text: Any) -> Any:
    if not d.candidates:
        return None
    table = _table(
        ("", True),
        ("candidate", False),
        ("held-out score", True),
        ("± se" if str(text("±")) == "±" else "se", True),
        ("gap closed", True),
    )
    for k, c in enumerate(d.candidates[:BEST], 1):
        se = number(c.get("se")) if finite(c.get("se")) else MISSING
        cells = (k, candidate_title(c), number(c.get("score")), se, percent(c.get("gap_closed")))
        table.add_row(*map(text, cells))
    if len(d.candidates) > BEST:
        table.caption = text(f"{len(d.candidates) - BEST} more in diagnosis.json")
        table.caption_justify = "left"
    return table
