"""A diagnosis in TensorBoard: the stages of the gap and closures as scalars, a few pictures, the verdict as text."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from bayessim_mjx.diagnosis.phrases.advice import headline, verdict_of
from bayessim_mjx.diagnosis.phrases.effects import candidate_title, line
from bayessim_mjx.diagnosis.result import Diagnosis
from bayessim_mjx.monitor.style import new_figure
from bayessim_mjx.monitor.writer import TensorBoard
from bayessim_mjx.quantities import finite, unit
from bayessim_mjx.report.gap_figures import falls, part_words, squares
from bayessim_mjx.report.look import DASH, FAINT, STAGE
from bayessim_mjx.report.words import STAGES, gap_closed, number, percent, repeated, stages_of

SHOWN = 4  # overlays in one picture
LINES = {"solid": "-", "dash": "--", "dot": ":"}


def tensorboard(diagnosis: Diagnosis, folder: str | Path) -> Path:
    """Write event files into `folder` (and the pictures beside them, in `media`); returns it."""
    with TensorBoard(folder) as writer:
        writer.scalars(0, scalars(diagnosis))
        writer.text("Diagnosis/verdict", _markdown(diagnosis))
        for tag, figure in pictures(diagnosis).items():
            writer.figure(f"Diagnosis/{tag}", figure, 0)
    return Path(folder)


def scalars(d: Diagnosis) -> dict[str, float]:
    """{tag: number}: gap by stage, by horizon and by channel; closures, shares and relative scores among rivals."""
    out = {f"Gap/{s}": v for s, v in stages_of(d).items()} | {"Gap/closed": gap_closed(stages_of(d))}
    for row in d.gap.horizons:
        out |= {f"Gap {row['name']}/{s}": row[s] for s in STAGES if finite(row.get(s))}
    for channel, row in d.gap.by_channel.items():
        out |= {f"Gap of {channel}/{s}": row[s] for s in STAGES if finite(row.get(s))}
    for e in d.effects:
        label = f"{e.name}@{e.where}"
        out |= {f"Closed/{label}": e.gap_closed, f"Score among rivals/{label}": e.weight_among_rivals}
    return {k: v for k, v in out.items() if finite(v)}


def _markdown(d: Diagnosis) -> str:
    lines = [f"**{verdict_of(d).badge}.** {headline(d)}", *d.sentences[1:], *map(line, d.effects)]
    return "\n\n".join(lines + [f"Warning: {w}" for w in d.warnings])


def pictures(d: Diagnosis) -> dict[str, Any]:
    """{tag: matplotlib Figure} of what there is to draw."""
    level = squares(_main(d), bool(d.effects))
    scored = [c for c in d.candidates if finite(c.get("score"))][:12]
    overlays = [o for o in d.details.get("overlays") or [] if len(o["time"])][:SHOWN]
    overlays = overlays if d.effects else [{**o, "with_effects": None} for o in overlays]
    out = {"waterfall": waterfall(level, _main(d))} if level else {}
    out |= {"candidates": candidates(scored)} if scored else {}
    return out | ({"overlays": overlay(overlays)} if overlays else {})


def _main(d: Diagnosis) -> dict[str, Any]:
    """Return the stages of the windows' horizon, with what their floor comes from."""
    return stages_of(d) | {"floor": "repeats" if repeated(d) else "noise"}


def waterfall(level: Mapping[str, float], stages: Mapping[str, Any]) -> Any:
    """Draw the squared gap from the delivered simulator down to the noise; roots over the stages."""
    figure = new_figure(8.0, 3.6, layout="constrained")
    axes = figure.subplots()
    bars = [("as delivered", 0.0, level["nominal"], "nominal", f"{number(stages['nominal'])} noise sd")]
    before, last = level["nominal"], "with_effects" if "with_effects" in level else "calibrated"
    for stage in falls(level):
        change = level[stage] - before
        low = min(before, level[stage])
        bars.append(
            (part_words(stage, level, stages.get("floor", "")), low, abs(change), stage, percent(change, sign=True))
        )
        if stage == last:
            bars.append((STAGES[stage], 0.0, level[stage], stage, f"{number(stages[stage])} noise sd"))
        before = level[stage]
    for k, (_, base, height, stage, words) in enumerate(bars):
        axes.bar(k, height, 0.62, base, color=STAGE[stage], edgecolor="black", linewidth=0.5)
        axes.text(k, base + height + 0.02, words, ha="center", va="bottom", fontsize=9)
    axes.set_xticks(range(len(bars)), [b[0].replace(" ", "\n", 1) for b in bars], fontsize=9)
    axes.set(ylabel="squared gap, share of the largest", ylim=(0, 1.14))
    return _plain(figure, axes)


def candidates(rows: Sequence[Mapping[str, Any]]) -> Any:
    """Held-out scores with one and two standard errors, the best on top."""
    figure = new_figure(8.0, 1.0 + 0.3 * len(rows), layout="constrained")
    axes = figure.subplots()
    at = np.arange(len(rows))[::-1]
    score = np.array([r["score"] for r in rows], float)
    se = np.array([r["se"] if finite(r.get("se")) else 0.0 for r in rows], float)
    colours = [STAGE["with_effects"] if k == 0 else FAINT for k in range(len(rows))]
    for reach, width in ((2, 1.2), (1, 3.0)):
        axes.hlines(at, score - reach * se, score + reach * se, colors=colours, linewidth=width)
    axes.scatter(score, at, c=colours, s=30, zorder=3)
    axes.axvline(0.0, color=FAINT, linewidth=0.8, linestyle=":")
    axes.set_yticks(at, [candidate_title(r)[:60] for r in rows], fontsize=9)
    axes.set_xlabel("held-out score, over the recalibrated simulator")
    return _plain(figure, axes)


def overlay(rows: Sequence[Mapping[str, Any]]) -> Any:
    """Measured and simulated motion of the first few logs and joints."""
    figure = new_figure(9.0, 0.6 + 1.7 * len(rows), layout="constrained")
    grid = figure.subplots(len(rows), 1, squeeze=False)[:, 0]
    for axes, row in zip(grid, rows, strict=True):
        time = np.asarray(row["time"], float)
        cuts = np.searchsorted(time, np.asarray(row.get("starts") or [], float) - 1e-9)
        cuts = cuts[(cuts > 0) & (cuts < len(time))]
        for stage in ("measured", "nominal", "calibrated", "with_effects"):
            if row.get(stage) is None:
                continue
            values = np.array([v if finite(v) else np.nan for v in row[stage]])
            style = LINES[DASH[stage]]
            words = STAGES.get(stage, stage)
            x, y = np.insert(time, cuts, np.nan), np.insert(values, cuts, np.nan)
            thick = dict(linewidth=4, alpha=0.3) if stage == "measured" else dict(linewidth=1.2)
            axes.plot(x, y, style, color=STAGE[stage], label=words, **thick)
        in_unit = f" ({unit(row['unit'])})" if row.get("unit") else ""
        axes.set_title(
            f"{row.get('log', '')}, {row.get('joint', '')}{in_unit}".replace("$", r"\$"), fontsize=9, loc="left"
        )
        _plain(figure, axes)
    grid[-1].set_xlabel("time (s)")
    grid[0].legend(frameon=False, fontsize=8, ncols=4, loc="lower right", bbox_to_anchor=(1.0, 1.0))
    return figure


def _plain(figure: Any, axes: Any) -> Any:
    axes.spines[["top", "right"]].set_visible(False)
    axes.tick_params(labelsize=9)
    return figure
