"""The benchmark's score as tables and pictures: console, score.md, score.json, confusion.csv/.txt/.png, score.html."""

import csv
import json
import math
import sys
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import weights as rival_weights
from score import Outcome, Rate, confusion, label, rates, read

Table = tuple[str, list[str], list[list[str]]]  # title, header, rows
OWN = "diagnosis"
WIDTH = 160  # of tables in files
STYLE = "body{font:14px sans-serif;margin:2em}table{border-collapse:collapse}td,th{border:1px solid;padding:3px 8px}"


def score(folders: Sequence[Path], out: Path) -> str:
    """Write everything into `out`; returns the text of score.md and prints the tables."""
    every = {OWN: [read(f) for f in folders]} | {name: _baseline(folders, name) for name in _baselines(folders)}
    run = [o for o in every[OWN] if o.said or not math.isnan(o.seconds)]
    left_out = [read(f, "left_out") for f in folders if (f / "left_out" / "exit.json").exists()]
    told = {name: rates(run if name == OWN else o, left_out if name == OWN else ()) for name, o in every.items()}
    tables = [_measures(told), _systems(run), _effects(run), rival_weights.table(run)]
    footer = _footer(every[OWN], run, len(left_out))
    text = "\n\n".join([*(markdown(t) for t in tables), footer])
    out.mkdir(parents=True, exist_ok=True)
    numbers = {name: {r.what: r.to_dict() for r in found} for name, found in told.items()}
    numbers[OWN]["seconds"] = _seconds(run)
    weights = rival_weights.forecasts(run)
    numbers[OWN]["weights"] = (
        dict(zip(("brier", "brier of the base rate"), rival_weights.brier(weights), strict=True)) if weights else {}
    )
    (out / "score.json").write_text(json.dumps(numbers, indent=1))
    (out / "score.md").write_text(text + "\n")
    matrices = {name: confusion(run if name == OWN else o) for name, o in every.items()}
    _files(matrices[OWN], out)
    (out / "score.html").write_text(page(tables, matrices, footer))
    _print(tables)
    return footer


def _baselines(folders: Sequence[Path]) -> list[str]:
    files = [f / "diagnosis" / "baselines.json" for f in folders]
    return list(dict.fromkeys(name for f in files if f.exists() for name in json.loads(f.read_text())))


def _baseline(folders: Sequence[Path], name: str) -> list[Outcome]:
    return [o for o in (read(f, baseline=name) for f in folders) if o.said]


def _measures(told: dict[str, list[Rate]]) -> Table:
    """Rates of the diagnosis with 95 % intervals beside those of the baselines."""
    others = [name for name in told if name != OWN]
    rows = []
    for i, rate in enumerate(told[OWN]):
        n, d = len(rate.answers), rate.to_dict()
        interval = f"{100 * d['low']:.0f} to {100 * d['high']:.0f} %" if n else "-"
        goal = (
            f"{'<=' if rate.most else '>='} {100 * rate.goal:.0f} %" if "intervals" not in rate.what else "85 to 95 %"
        )
        rows.append([rate.told, rate.text, interval, str(n), goal, *(told[name][i].text for name in others)])
    return "Measures", ["measure", OWN, "95 % interval", "n", "goal", *others], rows


def _systems(outcomes: Sequence[Outcome]) -> Table:
    header = ["system", "single", "isolable", "in the set", "double", "false alarms", "unexplained", "s", "compiling s"]
    rows = []
    for system in dict.fromkeys(o.truth["system"] for o in outcomes):
        own = [o for o in outcomes if o.truth["system"] == system]
        found = {r.what: r for r in rates(own)}
        cells = [
            "single, all: effect and place named", "single, isolable: effect and place named",
            "single: truth in the equivalence set", "double: both named", "nothing wrong: false alarm",
            "unknown cause: unexplained",
        ]  # fmt: skip
        took = [_middle([o.seconds for o in own]), _middle([o.compile_seconds for o in own])]
        rows.append([system, *(f"{sum(found[c].answers)}/{len(found[c].answers)}" for c in cells), *took])
    return "Systems", header, rows


def _middle(seconds: Sequence[float]) -> str:
    """Median, and the largest."""
    finite = [s for s in seconds if math.isfinite(s)]
    return f"{np.median(finite):.0f} (max {max(finite):.0f})" if finite else "-"


def _effects(outcomes: Sequence[Outcome]) -> Table:
    """Singles by effect: right, in the set, and what was said instead."""
    rows = []
    singles = [o for o in outcomes if o.kind == "single" and o.strong_enough]
    for name in sorted({o.truth["effects"][0]["name"] for o in singles}):
        own = [o for o in singles if o.truth["effects"][0]["name"] == name]
        right, inside = (sum(getattr(o, k)(o.truth["effects"][0]) for o in own) for k in ("right", "inside"))
        wrong = Counter(label(o) for o in own if not o.right(o.truth["effects"][0]))
        said = ", ".join(f"{what} {n}" for what, n in wrong.most_common())
        isolable = sum(bool(o.isolable) for o in own)
        rows.append([name, str(len(own)), str(isolable), str(right), str(inside), said])
    return "Single effects", ["hidden effect", "n", "isolable", "named", "in the set", "said instead"], rows


def _seconds(outcomes: Sequence[Outcome]) -> dict[str, float]:
    found: dict[str, float] = {}
    for key in ("seconds", "compile_seconds"):
        values = [v for v in (getattr(o, key) for o in outcomes) if math.isfinite(v)]
        found |= {f"median_{key}": float(np.median(values)), f"max_{key}": max(values)} if values else {}
    return found


def _footer(every: Sequence[Outcome], outcomes: Sequence[Outcome], left_out: int) -> str:
    weak = sum(not o.strong_enough for o in outcomes)
    failed = sum(o.said is None for o in outcomes)
    blind = sum(o.kind == "single" and o.isolable is None for o in outcomes)
    return (
        f"{len(outcomes)} of {len(every)} cases run; {failed} without a result; {weak} not counted because the effect "
        f"cannot be as strong as asked on that robot; {blind} singles not looked at for rivals (command isolable); "
        f"{left_out} run with their effect's family left out. "
        f"Seconds: median (largest), compilation contained and told apart. Rates with 95 % Wilson intervals."
    )


def markdown(table: Table) -> str:
    """A table for score.md."""
    _, header, rows = table
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def _print(tables: Sequence[Table]) -> None:
    from rich.console import Console
    from rich.table import Table as Shown

    console = Console(width=None if sys.stdout.isatty() else WIDTH)
    for title, header, rows in tables:
        shown = Shown(title=title)
        for name in header:
            shown.add_column(name)
        for row in rows:
            shown.add_row(*row)
        console.print(shown)


Matrix = tuple[list[str], list[str], np.ndarray]


def _files(matrix: Matrix, out: Path) -> None:
    """confusion.csv, .txt and .png."""
    rows, columns, counts = matrix
    with (out / "confusion.csv").open("w", newline="") as file:
        csv.writer(file).writerows([["hidden", *columns], *([r, *c] for r, c in zip(rows, counts, strict=True))])
    width = max((len(r) for r in rows), default=6)
    lines = [f"{k:2d} {name}" for k, name in enumerate(columns)]
    lines += ["", " " * width + "".join(f"{k:4d}" for k in range(len(columns)))]
    lines += [f"{r:{width}}" + "".join(f"{n or '.':>4}" for n in c) for r, c in zip(rows, counts, strict=True)]
    (out / "confusion.txt").write_text("\n".join(lines) + "\n")
    if counts.size:
        _png(matrix, out / "confusion.png")


def _png(matrix: Matrix, path: Path) -> None:
    from matplotlib.figure import Figure

    rows, columns, counts = matrix
    figure = Figure(figsize=(2.5 + 0.32 * len(columns), 2.5 + 0.28 * len(rows)), layout="constrained")
    axes = figure.subplots()
    share = counts / np.maximum(counts.sum(1, keepdims=True), 1)
    axes.imshow(share, cmap="Blues", vmin=0, vmax=1)
    axes.set_xticks(range(len(columns)), columns, rotation=90, fontsize=7)
    axes.set_yticks(range(len(rows)), rows, fontsize=7)
    axes.set(xlabel="named", ylabel="hidden")
    for i, j in np.argwhere(counts):
        dark = "white" if share[i, j] > 0.6 else "black"
        axes.text(j, i, str(counts[i, j]), ha="center", va="center", fontsize=7, color=dark)
    figure.savefig(path, dpi=120)


def heatmap(name: str, matrix: Matrix) -> Any:
    """The confusion matrix as a plotly figure: colour is the share of the row, numbers are cases."""
    import plotly.graph_objects as go

    rows, columns, counts = matrix
    share = counts / np.maximum(counts.sum(1, keepdims=True), 1)
    shown = go.Heatmap(
        z=share, x=columns, y=rows, text=np.where(counts > 0, counts.astype(str), ""), texttemplate="%{text}",
        colorscale="Blues", zmin=0, zmax=1, hovertemplate="hidden %{y}<br>named %{x}<br>%{z:.0%}<extra></extra>",
    )  # fmt: skip
    figure = go.Figure(shown)
    figure.update_layout(
        title=f"{name}: hidden against named", height=max(260, 150 + 22 * len(rows)), margin={"l": 170, "b": 150},
        xaxis={"title": "named", "tickangle": -60}, yaxis={"title": "hidden", "autorange": "reversed"},
    )  # fmt: skip
    return figure


def page(tables: Sequence[Table], matrices: dict[str, Matrix], footer: str) -> str:
    """One self-contained page: tables, then the confusion matrices of the diagnosis and of every baseline."""
    from html import escape

    parts = []
    for title, header, rows in tables:
        head = "".join(f"<th>{escape(h)}</th>" for h in header)
        body = "".join("<tr>" + "".join(f"<td>{escape(c)}</td>" for c in row) + "</tr>" for row in rows)
        parts.append(f"<h2>{title}</h2><table><tr>{head}</tr>{body}</table>")
    parts.append(f"<p>{escape(footer)}</p><h2>Confusion</h2>")
    shown = [(name, m) for name, m in matrices.items() if m[2].size]
    for i, (name, matrix) in enumerate(shown):
        parts.append(heatmap(name, matrix).to_html(full_html=False, include_plotlyjs=i == 0))
    return f'<!doctype html><meta charset="utf-8"><title>Blind benchmark</title><style>{STYLE}</style>' + "".join(parts)
