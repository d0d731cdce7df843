"""The sections of the page: plain dicts for the template, empty where the diagnosis has nothing to show."""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from bayessim_mjx.diagnosis.correction import stepping_of
from bayessim_mjx.diagnosis.phrases import time_step
from bayessim_mjx.diagnosis.phrases.advice import command, headline, purpose, verdict_of
from bayessim_mjx.diagnosis.phrases.effects import candidate_title, capital, titled
from bayessim_mjx.diagnosis.phrases.residual import parted
from bayessim_mjx.diagnosis.phrases.size import below_tiles, no_help, with_effects
from bayessim_mjx.diagnosis.phrases.verdict import counts_as_answer
from bayessim_mjx.diagnosis.phrases.verdict import number as noise_sd
from bayessim_mjx.diagnosis.result import Diagnosis, FoundEffect
from bayessim_mjx.diagnosis.statistics import of_one
from bayessim_mjx.quantities import count, finite
from bayessim_mjx.report import gap_figures, horizon_figures, marks, place_figures
from bayessim_mjx.report.choice import choice
from bayessim_mjx.report.look import STAGE
from bayessim_mjx.report.words import (
    MISSING,
    STAGES,
    between,
    closure,
    estimate,
    gap_closed,
    length,
    number,
    own_number,
    percent,
    quantity,
    repeated,
    spanned,
    stages_of,
    stages_told,
)

MOST_CANDIDATES = 20  # in the table; no source: a matter of style
OPEN_WARNINGS = 3  # more are folded away; no source: a matter of style
EFFECTS = STAGE["with_effects"]
TILES = {
    "nominal": "as delivered",
    "calibrated": "after recalibration",
    "with_effects": "",  # `with_effects`
}


def top(d: Diagnosis, folder: Path) -> dict[str, Any]:
    """Return the first screen: verdict, effects with places and numbers, three gaps, a command, warnings."""
    verdict, stages = verdict_of(d), stages_of(d)
    shown = [s for s in TILES if s in stages_told(d) and finite(stages[s])]
    return {
        "badge": verdict.badge,
        "verdict": d.verdict,
        "headline": headline(d),
        "sentences": parted(d)[0],
        "advice": verdict.advice,
        "command": command(d, folder),
        "purpose": purpose(command(d, folder)),
        "tiles": [{"words": TILES.get(s) or with_effects(d), "colour": STAGE[s], **_tile(d, s)} for s in shown],
        "size": below_tiles(d) if shown else "",
        "no_help": no_help(d),
        "warnings": len(d.warnings),
        "open": len(d.warnings) <= OPEN_WARNINGS,
    }


def _tile(d: Diagnosis, stage: str) -> dict[str, str]:
    """Return a stage's gap: of one joint in its unit, of several as a share of the motion; noise sd below."""
    level = getattr(d.gap, stage)
    noises = f"{noise_sd(level)} noise sd" + ", within the noise" * of_one(level**2).at_noise
    rows = [r for r in d.gap.physical.values() if finite(r.get(stage))]
    part = d.gap.shares.get(stage)
    if len(rows) == len(d.gap.physical) == 1:
        value, _, unit_ = length(rows[0][stage], rows[0]["unit"]).partition(" ")
        return {"value": value, "unit": unit_, "below": noises}
    if finite(part):
        rough = [(r[stage] / r["motion"], n) for n, r in d.gap.physical.items() if finite(r.get(stage)) and r["motion"]]
        _, joint = max(rough, default=(0.0, ""))
        worst = f"; {joint} {length(d.gap.physical[joint][stage], d.gap.physical[joint]['unit'])}" if joint else ""
        return {"value": percent(part), "unit": "of the motion", "below": noises + worst}
    return {"value": noise_sd(level), "unit": "noise sd", "below": ""}


def about(d: Diagnosis) -> list[str]:
    """Return robot, logs and date in short phrases."""
    a = d.about
    data = [str(p) for p in a.get("data") or []]
    where_ = f" in {', '.join(data[:3])}" + (f" and {len(data) - 3} more" if len(data) > 3 else "") if data else ""
    logs = count(a["logs"], "log") if a.get("logs") else "logs"
    size = [f"{number(a['seconds'])} s"] if finite(a.get("seconds")) else []
    size += [f"{a['conditions']} operating conditions"] if (a.get("conditions") or 0) > 1 else []
    size += ["one operating condition: in sample"] if a.get("conditions") == 1 else []
    return [
        text for text in (a.get("robot"), f"{logs}{where_}" if data else "", ", ".join(size), a.get("date")) if text
    ]


def simulated(d: Diagnosis) -> str:
    """Return step and integrator of the errors, and what the user stated: short phrases."""
    a, parts = d.about, []
    step = float(a.get("timestep") or math.nan)
    if finite(step):
        other = stepping_of(d)
        own = f", in place of the model's {time_step.milliseconds(other.own_step, other.own)}" if other else ""
        parts.append(f"errors at time steps of {number(1e3 * step)} ms ({a.get('integrator')}){own}")
    parts += [f"--{flag} {' '.join(texts)}" for flag, texts in (a.get("stated") or {}).items() if texts]
    return capital("; ".join(parts))


def how_far(d: Diagnosis) -> dict[str, Any]:
    """Waterfalls per horizon, the horizons side by side, shares, predicted against realised, and tables."""
    stages = stages_of(d)
    shared = [e for e in d.effects if finite(e.share)]
    shares = [{"effect": f"{e.name}@{e.where}", "share": e.share} for e in shared]
    rows: list[dict[str, Any]] = [{"name": "overall", **stages}]
    same = [h for h in d.gap.horizons if all(h.get(s) == stages[s] for s in ("nominal", "with_effects"))]
    rows = list(d.gap.horizons) if same else rows + list(d.gap.horizons)
    falls = [(str(r["name"]), f) for r in rows if (f := gap_figures.waterfall(r, shares, bool(d.effects)))]
    start = next((k for k, (name, _) in enumerate(falls) if same and name == str(same[0]["name"])), 0)
    return {
        "choice": choice(["horizon"], [((name,), f) for name, f in falls], start),
        "horizons": horizon_figures.horizons(d.gap.horizons, bool(d.effects)),
        "table": _table(d, [_stages_row(r, len(d.gap.physical)) for r in rows if finite(r.get("nominal"))]),
        "channels": _table(d, _channels(d)),
        "repeated": repeated(d),
        "several": len(d.gap.physical) != 1 and bool(d.gap.shares),
        "beyond": bool(d.gap.beyond),
        "shapley": [
            {
                "name": capital(titled(e.name, e.where)),
                "share": percent(e.share),
                "mark": marks.bar(e.share, None, EFFECTS),
            }
            for e in shared
        ],
        "closure": _closure(d),
        "unit": d.gap.unit,
    }


def _stages_row(row: Mapping[str, Any], joints: int) -> dict[str, Any]:
    """One horizon: the joint's error or the share of the motion, and noise sd with their interval below."""
    own: Mapping[str, Any] = next(iter((row.get("physical") or {}).values()), {}) if joints == 1 else {}
    shares, cells = row.get("shares") or {}, {}
    for stage in STAGES:
        noises = number(row.get(stage)) + spanned((row.get("ci") or {}).get(stage))
        value = length(own.get(stage), own.get("unit", "")) if own else percent(shares.get(stage))
        known = value != MISSING
        cells[stage] = {"value": value, "between": f"{noises} sd"} if known else {"value": noises, "between": ""}
    return {"name": str(row["name"]), "cells": cells, "closed": percent(gap_closed(row)), "more": [], "beyond": False}


def _table(d: Diagnosis, rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Rows and those of the stages that some row knows; the floor where runs were repeated, the noise is 1 sd."""
    shown = {s for s in stages_told(d) if s != "noise_floor"}
    known = [s for s in STAGES if s in shown and any(r["cells"][s]["value"] != MISSING for r in rows)]
    return {"rows": rows, "stages": known, "closed": any(r["closed"] != MISSING for r in rows), "heads": MORE}


MORE = ("largest error", "tolerance", "range of motion", "noise")


def _channels(d: Diagnosis) -> list[dict[str, Any]]:
    rows = []
    for name, noises in d.gap.by_channel.items():
        physical = d.gap.physical.get(name, {})
        row = _stages_row({"name": name, **noises, "physical": {name: physical}}, 1 if physical else 0)
        keys = ("largest", "tolerance", "motion", "noise")
        known = any(finite(physical.get(k)) for k in keys)
        row["more"] = [length(physical.get(k), physical.get("unit", "")) for k in keys] if known else []
        row["beyond"] = bool(physical.get("beyond"))
        rows.append(row)
    return rows


def _closure(d: Diagnosis) -> list[dict[str, Any]]:
    """Tabulate the shares closed as predicted and as realised, of each effect and of all together."""
    own = [f"{e.name}@{e.where}" for e in d.effects]
    rows: list[tuple[Any, ...]] = [
        ([n], e.predicted_gap_closed, e.gap_closed, e.gap_closed_ci) for n, e in zip(own, d.effects, strict=True)
    ]
    rows += [(own, *(d.gap.closed.get(k) for k in ("predicted", "realised", "ci")))] if len(own) > 1 else []
    limits = marks.scale_of([share for _, predicted, realised, _ in rows for share in (predicted, realised)] + [1.0])
    return [
        {
            "name": candidate_title({"effects": names}),
            "predicted": percent(predicted),
            "realised": percent(realised),
            "mark": marks.interval(realised, ci, limits, EFFECTS, hollow=predicted),
        }
        for names, predicted, realised, ci in rows
    ]


def effects(d: Diagnosis) -> list[dict[str, Any]]:
    score = "probability among rivals" if d.evidence else "relative score among rivals (pseudo-BMA, no probability)"
    return [_effect(e) | {"score": score} for e in d.effects]


def _effect(e: FoundEffect) -> dict[str, Any]:
    return {
        "title": capital(titled(e.name, e.where)),
        "label": f"{e.name}@{e.where}",
        "sentence": e.sentence,
        "parameters": [
            dict(zip(("name", "value"), quantity(k, v, e.name), strict=True)) for k, v in e.parameters.items()
        ],
        "weight": percent(e.weight_among_rivals) if finite(e.weight_among_rivals) else "",
        "closed": percent(e.gap_closed),
        "ci": between(*e.gap_closed_ci),
        "mark": marks.bar(e.gap_closed, e.gap_closed_ci, EFFECTS),
        "weight_mark": marks.bar(e.weight_among_rivals, None, "#9aa3ab") if finite(e.weight_among_rivals) else "",
        "predicted": percent(e.predicted_gap_closed) if finite(e.predicted_gap_closed) else "",
        "share": percent(e.share) if finite(e.share) and percent(e.share) != percent(e.gap_closed) else "",
        "rivals": [
            {
                "name": candidate_title(r),
                "closed": percent(r["gap_closed"]) if finite(r.get("gap_closed")) else "",
                "weight": percent(r["weight"]) if finite(r.get("weight")) else "",
                "why": r.get("why") or "",
            }
            for r in e.equivalent_to
        ],
    }


def candidates(d: Diagnosis) -> dict[str, Any]:
    """Return the best of the ranking, scores with one and two standard errors on a scale that all rows share."""
    rows, answer = [], d.rank
    shown = {k: c for k, c in enumerate(d.candidates, 1) if k <= MOST_CANDIDATES or k == answer}
    reach = [c["score"] + k * (c.get("se") or 0.0) for c in shown.values() if finite(c.get("score")) for k in (-2, 2)]
    limits = marks.scale_of(reach, zero=True)
    hinged = all(row.get("unit") == "rad" for row in d.gap.physical.values())
    for k, c in shown.items():
        score, se = c.get("score"), c.get("se") or 0.0
        spans = [(score - m * se, score + m * se) for m in (2, 1)] if finite(score) and finite(se) else [None, None]
        colour = EFFECTS if k == answer else "#5b6670"
        rows.append(
            {
                "rank": k,
                "name": candidate_title(c),
                "score": number(score),
                "se": number(se) if se else "",
                "chosen": k == answer,
                "same": counts_as_answer(d, c),
                "closed": closure(c.get("gap_closed")),
                "absorbed": percent(c.get("absorbed")),
                "values": "; ".join(own_number(n, v, hinged) for n, v in _own(c).items() if n not in d.parameters),
                "mark": marks.interval(score, spans[0], limits, colour, (0.0,), inner=spans[1]),
            }
        )
    return {
        "rows": rows,
        "more": len(d.candidates) - len(shown),
        "absorbed": any(finite(c.get("absorbed")) for c in shown.values()),
    }


def _own(candidate: Mapping[str, Any]) -> dict[str, Any]:
    """Return the values of the candidate's own parameters: `<where>.<effect>.<parameter>`, or those without a place."""
    labels = [str(x).partition("@") for x in candidate.get("effects") or []]
    heads = tuple(f"{where}.{name}." for name, _, where in labels)
    values = candidate.get("parameters") or {}
    return {k: v for k, v in values.items() if k.startswith(heads) or "." not in k} if heads else {}


def where(d: Diagnosis) -> dict[str, Any]:
    """Shares of the channels, links of the chain, and pictures per joint, the one with most of the gap first."""
    ranked = sorted(d.where, key=lambda p: -p.share if finite(p.share) else 0.0)
    order = {p.channel: k for k, p in reversed(list(enumerate(ranked)))}
    by_joint: dict[str, list] = {}
    for row in d.details.get("maps") or []:
        by_joint.setdefault(str(row["joint"]), []).append(row)
    joints = sorted(by_joint, key=lambda j: order.get(j, len(order)))
    waves = sorted(d.details.get("frequency") or [], key=lambda r: order.get(r["joint"], len(order)))
    return {
        "places": [
            {
                "channel": p.channel,
                "kind": p.kind,
                "share": percent(p.share),
                "ci": between(*p.ci),
                "region": p.region,
                "mark": marks.bar(p.share, p.ci, STAGE["nominal"]),
            }
            for p in ranked
        ],
        "without": parted(d)[1],
        "before": list((d.details.get("before_simulation") or {}).get("lines") or []),
        "links": [_link(x) for x in d.details.get("links") or []],
        "maps": choice(["joint"], [((j,), place_figures.maps(by_joint[j])) for j in joints]),
        "frequency": choice(["joint"], [((str(r["joint"]),), place_figures.frequency(r)) for r in waves]),
    }


def _link(x: Mapping[str, Any]) -> dict[str, Any]:
    """Return a link of the chain; its verdict without the name and the numbers that stand beside it."""
    head, _, rest = (words := str(x.get("verdict") or "")).partition(": ")
    words = (rest if "->" in head and rest else words).rpartition(" (corr ")[0] or (rest if "->" in head else words)
    return {
        "name": str(x["name"]).replace("->", "→"),
        "verdict": words,
        "slope": number(x.get("slope")),
        "correlation": number(x.get("correlation"), 4),
        "lag": estimate(x.get("lag"), in_unit="s") if finite(x.get("lag")) else MISSING,
        "tested": any(finite(x.get(k)) for k in ("slope", "correlation", "lag")),
    }
