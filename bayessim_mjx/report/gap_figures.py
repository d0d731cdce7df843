"""How far: the waterfall of the squared gap."""

import re
from collections.abc import Mapping, Sequence
from typing import Any

from bayessim_mjx.diagnosis.phrases.effects import label_title
from bayessim_mjx.quantities import finite
from bayessim_mjx.report.look import (
    FAINT,
    HATCH,
    INK,
    NARROW,
    OVER,
    STAGE,
    WIDTH,
    axis,
    figure,
    note,
    text,
)
from bayessim_mjx.report.words import STAGES, known_span, number, percent, wide

# what takes the squared gap down to each stage
PARTS = {
    "calibrated": "recalibration alone",
    "with_effects": "named effects",
    "reducible_floor": "not explained",
    "noise_floor": "not explained",
}
FLOORS = {"repeats": "differs between repeats", "start": "uncertain start"}  # what lies between floor and noise
TICKS = [0.0, 0.5, 1.0]  # few enough for a phone
HIGHEST = 1.6  # of the largest squared gap: where the picture ends, intervals with it
STEPS = ("nominal", "calibrated", "with_effects")


def squares(stages: Mapping[str, Any], effects: bool = True) -> dict[str, float]:
    """Squared gap of each known stage as a share of the largest; empty where a needed one is unknown.

    The floor is a stage of its own only where something says what lies between it and the noise.
    """
    if not all(finite(stages.get(s)) for s in STEPS) or not stages["nominal"]:
        return {}
    shown = [s for s in STAGES if s != "with_effects" or effects]
    shown = [s for s in shown if s != "reducible_floor" or stages.get("floor") in FLOORS]
    return {s: (stages[s] / _largest(stages)) ** 2 for s in shown if finite(stages.get(s))}


def _largest(stages: Mapping[str, Any]) -> float:
    return float(max(stages[s] for s in STEPS))


def falls(level: Mapping[str, float]) -> list[str]:
    """Stages that have a bar of their own: a floor only where it lies below the stage before.

    A model that predicts below the estimated noise leaves nothing unexplained; the noise was estimated too large.
    """
    known = [s for s in PARTS if s in level]
    floors = ("reducible_floor", "noise_floor")
    return [s for k, s in enumerate(known) if s not in floors or level[s] < level[known[k - 1]]]


def part_words(stage: str, level: Mapping[str, float], floor: str = "") -> str:
    """Name the part between a stage and the one before."""
    return FLOORS[floor] if stage == "noise_floor" and "reducible_floor" in level else PARTS[stage]


def waterfall(
    stages: Mapping[str, Any], shares: Sequence[Mapping[str, Any]], effects: bool = True
) -> dict[str, Any] | None:
    """Rows from the delivered simulator's squared gap down to the noise; `shares` (Shapley) split the effects' part.

    Args:
        stages: one horizon; effects: whether there are any.

    Returns:
        None where a stage is unknown.
    """
    level, ci = squares(stages, effects), stages.get("ci")
    if not level:
        return None
    last, words = ("with_effects", "with the effects") if effects else ("calibrated", "recalibrated")
    rows = [_total("as delivered", "nominal", stages, level, ci), _drop("calibrated", level)]
    rows += _effects(shares, level) if effects else []
    rows += [_total(words, last, stages, level, ci)]
    rows += [_drop(s, level, stages.get("floor", "")) for s in falls(level)[falls(level).index(last) + 1 :]]
    rows += [_total("measurement noise", "noise_floor", stages, level, ci)] if "noise_floor" in level else []
    ends = [min(c["base"] + c["height"] + c["error"][1], HIGHEST) for c in rows]
    marks = [
        note(c["label"], end, k, xref="x", yref="y", xanchor="left", xshift=4, align="left", font={"size": 12.5})
        for k, (c, end) in enumerate(zip(rows, ends, strict=True))
    ]
    longest = max(len(line) for c in rows for line in re.sub("</?b>", "", c["label"]).split("<br>"))
    return figure(
        [_bars(rows), _spans(rows)],
        WIDTH,
        60 + 36 * len(rows),
        least=NARROW,
        shapes=_links(rows),
        annotations=marks,
        xaxis=axis(
            "squared gap, share of the largest",
            tickvals=TICKS,
            tickformat=".0%",
            tickangle=0,
            range=[0, max(1.0, *ends) * (1 + 0.035 * longest)],
        ),
        yaxis=axis(
            tickvals=list(range(len(rows))),
            ticktext=[c["name"] for c in rows],
            showgrid=False,
            ticks="",
            range=[len(rows) - 0.5, -0.5],
        ),
        margin={"l": 132, "r": 8, "t": 4, "b": 46},
    )


def _spans(rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Intervals of the bars that have one."""
    sure = [k for k, c in enumerate(rows) if any(c["error"])]
    return {
        "type": "scatter",
        "mode": "markers",
        "x": [rows[k]["end"] for k in sure],
        "y": sure,
        "hoverinfo": "skip",
        "marker": {"size": 0.1, "color": INK},
        "error_x": {
            "type": "data",
            "symmetric": False,
            "arrayminus": [rows[k]["error"][0] for k in sure],
            "array": [rows[k]["error"][1] for k in sure],
            "color": INK,
            "thickness": 1.2,
            "width": 4,
        },
    }


def _bars(rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    return {
        "type": "bar",
        "orientation": "h",
        "x": [c["height"] for c in rows],
        "y": list(range(len(rows))),
        "base": [c["base"] for c in rows],
        "width": 0.62,
        "marker": {
            "color": [c["colour"] for c in rows],
            "line": {"color": INK, "width": 0.6},
            "pattern": {"shape": [c["hatch"] for c in rows], **OVER},
        },
        "hovertext": [c["hover"] for c in rows],
        "hoverinfo": "text",
    }


def _links(rows: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Dotted lines from the end of each bar to the next."""
    ends = [c["end"] for c in rows]
    return [
        {
            "type": "line",
            "x0": e,
            "x1": e,
            "y0": k + 0.31,
            "y1": k + 0.69,
            "line": {"color": FAINT, "width": 1, "dash": "dot"},
        }
        for k, e in enumerate(ends[:-1])
    ]


def _total(words: str, stage: str, stages: Mapping[str, Any], level: Mapping[str, float], ci: Any) -> dict[str, Any]:
    span = known_span((ci or {}).get(stage))
    if span is not None and wide(span):
        span, between = None, "<br>(wide interval)"
    else:
        between = f"<br>({number(span[0])} to {number(span[1])})" if span else ""
    ends = [(s / _largest(stages)) ** 2 for s in span] if span else [level[stage]] * 2
    return {
        "name": _wrap(words),
        "base": 0.0,
        "height": level[stage],
        "end": level[stage],
        "colour": STAGE[stage],
        "hatch": "",
        "label": f"<b>{number(stages[stage])}</b>{'' if span and ends[1] <= HIGHEST else between}",
        "hover": f"{words}: {number(stages[stage])}{between.replace('<br>', ' ')}",
        "error": (max(level[stage] - ends[0], 0.0), max(min(ends[1], HIGHEST) - level[stage], 0.0)),
    }


def above(stage: str, level: Mapping[str, float]) -> float:
    """Level of the known stage before `stage`."""
    order = list(level)
    return level[order[order.index(stage) - 1]]


def _drop(stage: str, level: Mapping[str, float], floor: str = "") -> dict[str, Any]:
    return _step(part_words(stage, level, floor), stage, above(stage, level), level[stage])


def _step(words: str, stage: str, top: float, end: float) -> dict[str, Any]:
    label = percent(end - top, sign=True)
    return {
        "name": _wrap(words),
        "base": min(top, end),
        "height": abs(top - end),
        "end": end,
        "colour": STAGE[stage],
        "hatch": HATCH[stage],
        "label": label,
        "error": (0.0, 0.0),
        "hover": f"{words}: {label} of the largest squared gap",
    }


def _effects(shares: Sequence[Mapping[str, Any]], level: Mapping[str, float]) -> list[dict[str, Any]]:
    """Return the effects' part split by their shares of it, or in one piece."""
    known = [s for s in shares if finite(s.get("share"))]
    total, whole = sum(s["share"] for s in known), level["calibrated"] - level["with_effects"]
    if not 1 <= len(known) <= 6 or total <= 0:
        return [_drop("with_effects", level)] if known or abs(whole) > 1e-6 else []
    out, start = [], level["calibrated"]
    for share in known:
        what, _, place = label_title(share["effect"], short=True).partition(" · ")
        drop = _step(text(f"{what} {place}"), "with_effects", start, start - whole * share["share"] / total)
        out.append(drop | {"name": _wrap(text(f"{what} {place}".strip(), 38))})
        start = out[-1]["end"]
    return out


def _wrap(words: str, width: int = 21) -> str:
    """Break words into lines of fewer than `width` characters, as far as spaces allow."""
    lines = [""]
    for word in words.split(" "):
        if lines[-1] and len(lines[-1]) + len(word) >= width:
            lines.append("")
        lines[-1] = f"{lines[-1]} {word}".strip()
    return "<br>".join(lines)
