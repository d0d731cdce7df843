"""How far: the parts of the squared gap over the horizons."""

from collections.abc import Mapping, Sequence
from typing import Any

from bayessim_mjx.report.gap_figures import FLOORS, PARTS, above, part_words, squares
from bayessim_mjx.report.look import HATCH, INK, NARROW, OVER, STAGE, WIDTH, axis, figure, text
from bayessim_mjx.report.words import percent


def horizons(rows: Sequence[Mapping[str, Any]], effects: bool = True) -> dict[str, Any] | None:
    """Each horizon's squared gap as one bar of 100 %, cut into what closes which part."""
    known = [(str(r.get("name", "")), r.get("floor", ""), squares(r, effects)) for r in rows]
    known = [row for row in known if row[2]][::-1]
    if len(known) < 2:
        return None
    names = [text(name) for name, _, _ in known]
    cuts = [_cuts(level, floor) for _, floor, level in known]
    parts = list(dict.fromkeys(key for key in ORDER if any(key in c for c in cuts)))
    data = []
    for words, stage in parts:
        sizes, hatch = [c.get((words, stage), 0.0) for c in cuts], HATCH[stage] if words != LAST[0] else ""
        data.append(
            {
                "type": "bar",
                "orientation": "h",
                "y": names,
                "x": sizes,
                "name": words,
                "width": 0.6,
                "marker": {
                    "color": STAGE[stage],
                    "line": {"color": "white", "width": 1},
                    "pattern": {"shape": hatch, **OVER},
                },
                "text": [percent(s) if s > 0.045 else "" for s in sizes],
                "textposition": "inside",
                "insidetextanchor": "middle",
                "textangle": 0,
                "constraintext": "none",
                "textfont": {"color": "white" if stage in ("nominal", "with_effects") else INK, "size": 12},
                "hovertemplate": f"{words}: %{{x:.1%}}<extra></extra>",
            }
        )
    return figure(
        data,
        WIDTH,
        120 + 34 * len(known),
        least=NARROW,
        barmode="stack",
        showlegend=True,
        margin={"l": 70, "r": 12, "t": 34, "b": 30},
        xaxis=axis(tickformat=".0%", range=[0, 1.02], showgrid=False),
        yaxis=axis(showgrid=False, ticks=""),
        legend={
            "orientation": "h",
            "x": 0,
            "y": 1.02,
            "yanchor": "bottom",
            "traceorder": "normal",
            "font": {"size": 12},
        },
    )


LAST = ("measurement noise", "noise_floor")
ORDER = (
    (PARTS["calibrated"], "calibrated"),
    (PARTS["with_effects"], "with_effects"),
    (PARTS["noise_floor"], "reducible_floor"),
    *((words, "noise_floor") for words in FLOORS.values()),
    LAST,
)


def _cuts(level: Mapping[str, float], floor: str) -> dict[tuple[str, str], float]:
    """{(words, stage of the colour): part of one bar}; a stage that makes the gap larger takes no part of it."""
    out = {}
    for stage in (s for s in PARTS if s in level):
        words = part_words(stage, level, floor)
        key = (words, "reducible_floor" if words == PARTS["noise_floor"] else stage)
        out[key] = max(above(stage, level) - level[stage], 0.0)
    return out | ({LAST: level["noise_floor"]} if "noise_floor" in level else {})
