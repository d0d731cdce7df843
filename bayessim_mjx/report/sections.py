"""What each section of the page shows: plain dicts for the template, empty where the diagnosis has nothing to show."""

from collections.abc import Mapping, Sequence
from typing import Any

from bayessim_mjx.diagnosis.result import Diagnosis, FoundEffect
from bayessim_mjx.report import gap_figures, marks, place_figures
from bayessim_mjx.report.look import STAGE
from bayessim_mjx.report.words import (
    STAGES,
    VERDICTS,
    candidate_title,
    effect_line,
    effect_title,
    estimate,
    finite,
    gap_closed,
    headline,
    label_title,
    number,
    percent,
    quantity,
    unit,
)

MOST_CANDIDATES = 20
OVERLAY_NUMBERS = 120_000  # in all overlays together, so that the page stays a few MB
FEWEST_POINTS = 200


def top(d: Diagnosis) -> dict[str, Any]:
    """Verdict, sentences, what to do next and the key numbers."""
    verdict = VERDICTS[d.verdict]
    stages = stages_of(d)
    tiles = [
        {"words": f"gap {STAGES[s]}", "value": number(stages[s]), "unit": "noise sd", "colour": STAGE[s]}
        for s in ("nominal", "calibrated", "with_effects", "reducible_floor")
        if finite(stages[s])
    ]
    closed = gap_closed(stages)
    if finite(closed):
        tiles.append({"words": "of the reducible gap closed", "value": percent(closed), "unit": "", "colour": "#1f2429"})
    found = [{"line": effect_line(e), "rivals": len(e.equivalent_to)} for e in d.effects]
    return {
        "badge": verdict.badge, "verdict": d.verdict, "headline": headline(d), "sentences": d.sentences[1:],
        "advice": verdict.advice, "tiles": tiles, "found": found, "warnings": len(d.warnings),
    }  # fmt: skip


def stages_of(d: Diagnosis) -> dict[str, float]:
    return {s: getattr(d.gap, s) for s in STAGES}


def shares_of(d: Diagnosis) -> list[dict[str, Any]]:
    """Shapley shares [{"effect", "share", "low", "high"}]: from the details, else from the effects."""
    listed = d.details.get("shapley") or []
    own = [{"effect": f"{e.name}@{e.where}", "share": e.share} for e in d.effects if finite(e.share)]
    return list(listed) or own


def how_far(d: Diagnosis) -> dict[str, Any]:
    """Waterfalls per horizon, the horizons side by side, shares, predicted against realised, and tables."""
    stages, shares = stages_of(d), shares_of(d)
    rows = [{"name": "overall", **stages}]
    same = [h for h in d.gap.horizons if all(h.get(s) == stages[s] for s in ("nominal", "with_effects"))]
    rows = list(d.gap.horizons) if same else rows + list(d.gap.horizons)
    falls = [(str(r["name"]), f) for r in rows if (f := gap_figures.waterfall(r, shares, r.get("ci")))]
    start = next((k for k, (name, _) in enumerate(falls) if same and name == str(same[0]["name"])), 0)
    return {
        "choice": choice(["horizon"], [((name,), f) for name, f in falls], start),
        "horizons": gap_figures.horizons(d.gap.horizons),
        "table": [_stages_row(r, r.get("ci") or {}) for r in rows if finite(r.get("nominal"))],
        "channels": _channels(d),
        "shapley": _shapley(d.details.get("shapley") or []),
        "closure": _closure(d.details.get("closure") or []),
        "unit": d.gap.unit,
    }  # fmt: skip


def _stages_row(row: Mapping[str, Any], ci: Mapping[str, Any], name: str = "") -> dict[str, Any]:
    cells = []
    for stage in STAGES:
        span = ci.get(stage)
        between = f"{number(span[0])} – {number(span[1])}" if span and all(map(finite, span)) else ""
        cells.append({"value": number(row.get(stage)), "between": between})
    return {"name": name or str(row.get("name", "")), "cells": cells, "closed": percent(gap_closed(row))}


def _channels(d: Diagnosis) -> list[dict[str, Any]]:
    rows = [_stages_row(v, {}, k) for k, v in d.gap.by_channel.items()]
    for row in rows:
        physical = d.gap.physical.get(row["name"], {})
        for cell, stage in zip(row["cells"], STAGES, strict=True):
            if finite(physical.get(stage)):
                cell["between"] = f"{number(physical[stage])} {unit(physical.get('unit', ''))}"
    return rows


def _shapley(rows: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    return [
        {"name": label_title(r["effect"]), "share": percent(r.get("share")), "between": between(r.get("low"), r.get("high")),
         "mark": marks.bar(r.get("share"), (r.get("low"), r.get("high")), STAGE["with_effects"])}
        for r in rows
    ]  # fmt: skip


def _closure(rows: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    limits = marks.scale_of([r.get(k) for r in rows for k in ("predicted", "realised")] + [1.0])
    return [
        {"name": candidate_title(r), "predicted": percent(r.get("predicted")), "realised": percent(r.get("realised")),
         "mark": marks.interval(r.get("realised"), None, limits, STAGE["with_effects"], hollow=r.get("predicted"))}
        for r in rows
    ]  # fmt: skip


def between(low: Any, high: Any) -> str:
    return f"{percent(low)} – {percent(high)}" if finite(low) and finite(high) else ""


def effects(d: Diagnosis) -> list[dict[str, Any]]:
    return [_effect(e) for e in d.effects]


def _effect(e: FoundEffect) -> dict[str, Any]:
    return {
        "title": effect_title(e.name, e.where), "label": f"{e.name}@{e.where}", "sentence": e.sentence,
        "parameters": [dict(zip(("name", "value"), quantity(k, v), strict=True)) for k, v in e.parameters.items()],
        "probability": percent(e.probability), "closed": percent(e.gap_closed), "ci": between(*e.gap_closed_ci),
        "mark": marks.bar(e.gap_closed, e.gap_closed_ci, STAGE["with_effects"]),
        "chance": marks.bar(e.probability, None, "#9aa3ab"),
        "predicted": percent(e.predicted_gap_closed) if finite(e.predicted_gap_closed) else "",
        "share": percent(e.share) if finite(e.share) else "",
        "rivals": [
            {"name": candidate_title(r), "closed": percent(r["gap_closed"]) if finite(r.get("gap_closed")) else "",
             "why": r.get("why") or ""}
            for r in e.equivalent_to
        ],
    }  # fmt: skip


def candidates(d: Diagnosis) -> dict[str, Any]:
    """The best of the ranking, scores with one and two standard errors on a scale that all rows share."""
    shown = d.candidates[:MOST_CANDIDATES]
    reach = [c["score"] + k * (c.get("se") or 0.0) for c in shown if finite(c.get("score")) for k in (-2, 2)]
    limits = marks.scale_of(reach, zero=True)
    confirmed = {f"{e.name}@{e.where}" for e in d.effects}
    rows = []
    for k, c in enumerate(shown, 1):
        score, se = c.get("score"), c.get("se") or 0.0
        spans = [(score - m * se, score + m * se) for m in (2, 1)] if finite(score) and finite(se) else [None, None]
        chosen = set(c.get("effects") or []) == confirmed and bool(confirmed)
        colour = STAGE["with_effects"] if chosen else "#5b6670"
        rows.append({
            "rank": k, "name": candidate_title(c), "score": number(score), "se": number(se) if se else "", "chosen": chosen,
            "closed": percent(c.get("gap_closed")), "absorbed": percent(c.get("absorbed")),
            "values": "; ".join(_value(n, v) for n, v in (c.get("parameters") or {}).items()),
            "mark": marks.interval(score, spans[0], limits, colour, (0.0,), inner=spans[1]),
        })  # fmt: skip
    return {"rows": rows, "more": len(d.candidates) - len(shown), "values": any(r["values"] for r in rows)}


def _value(name: str, value: Any) -> str:
    words = name.rpartition(".")[2].replace("_", " ")
    if isinstance(value, Mapping):
        return f"{words} {estimate(value.get('mean'), value.get('sd'), value.get('unit', ''))}"
    return f"{words} {number(value)}"


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
            {"channel": p.channel, "kind": p.kind, "share": percent(p.share), "ci": between(*p.ci), "region": p.region,
             "mark": marks.bar(p.share, p.ci, STAGE["nominal"])}
            for p in ranked
        ],
        "links": [
            {"name": x["name"], "verdict": x.get("verdict") or "", "slope": number(x.get("slope")),
             "correlation": number(x.get("correlation"), 4), "lag": estimate(x.get("lag"), in_unit="s")}
            for x in d.details.get("links") or []
        ],
        "maps": choice(["joint"], [((j,), place_figures.maps(by_joint[j])) for j in joints]),
        "frequency": choice(["joint"], [((str(r["joint"]),), place_figures.frequency(r)) for r in waves]),
    }  # fmt: skip


def overlays(d: Diagnosis) -> dict[str, Any]:
    """Measured against simulated by log and joint, and every log's gap; beyond the page's budget the smallest gaps go."""
    rows = list(d.details.get("overlays") or [])
    most = max(OVERLAY_NUMBERS // (8 * FEWEST_POINTS), 1)
    kept = rows if len(rows) <= most else sorted(rows, key=_worst, reverse=True)[:most]
    points = max(FEWEST_POINTS, min(2000, OVERLAY_NUMBERS // (8 * max(len(kept), 1))))
    panels = [((str(r.get("log", "")), str(r.get("joint", ""))), gap_figures.overlay(r, points)) for r in kept if len(r["time"])]
    lines = d.details.get("episodes") or []
    return {
        "choice": choice(["log", "joint"], panels), "left": len(rows) - len(kept),
        "episodes": gap_figures.episodes(lines[:60]) if lines else None,
    }  # fmt: skip


def _worst(row: Mapping[str, Any]) -> float:
    return max((abs(a - b) for a, b in zip(row["measured"], row.get("nominal") or [], strict=False) if finite(a) and finite(b)), default=0.0)


def choice(axes: Sequence[str], panels: Sequence[tuple[tuple[str, ...], dict]], start: int = 0) -> dict[str, Any]:
    """Panels of which one is shown: {"axes": [{"name", "options"}], "panels": [{"keys": [option numbers], "title", "figure"}]}."""
    options = [list(dict.fromkeys(keys[k] for keys, _ in panels)) for k in range(len(axes))]
    return {
        "axes": [{"name": n, "options": o, "at": o.index(panels[start][0][k])} for k, (n, o) in enumerate(zip(axes, options, strict=True)) if len(o) > 1],
        "panels": [
            {"keys": [options[k].index(key) for k, key in enumerate(keys) if len(options[k]) > 1],
             "title": ", ".join(f"{n} {key}" for n, key in zip(axes, keys, strict=True) if key),
             "figure": figure, "shown": k == start}
            for k, (keys, figure) in enumerate(panels)
        ],
    }  # fmt: skip


def parameters(d: Diagnosis) -> dict[str, Any]:
    """Recalibrated parameters in their ranges, and their estimates per operating condition."""
    rows = []
    for name, p in d.parameters.items():
        mean, sd, low, high = (p.get(k) for k in ("mean", "sd", "low", "high"))
        ranged = finite(low) and finite(high) and high > low
        limits = (low, high) if ranged else marks.scale_of([mean, p.get("nominal")], zero=False)
        ci = (max(mean - 1.645 * sd, limits[0]), min(mean + 1.645 * sd, limits[1])) if finite(mean) and finite(sd) else None
        colour = STAGE["nominal"] if p.get("structural") else STAGE["with_effects"]
        rows.append({
            "name": name, "nominal": number(p.get("nominal")), "value": estimate(mean, sd), "unit": unit(p.get("unit") or ""),
            "structural": p.get("structural") or "", "low": number(low) if ranged else "", "high": number(high) if ranged else "",
            "mark": marks.interval(mean, ci, limits, colour, (p.get("nominal"),), width=150),
        })  # fmt: skip
    found = d.details.get("groups") or {}
    some = found.get("names") and found.get("parameters")
    moves = {k: found["parameters"][k] for k in sorted(found["parameters"], key=lambda k: not d.parameters.get(k, {}).get("structural"))} if some else {}
    return {"rows": rows, "groups": place_figures.groups(found["names"], moves, d.parameters) if moves else None,
            "left": max(len(moves) - 12, 0)}  # fmt: skip


def isolability(d: Diagnosis) -> dict[str, Any]:
    found = d.details.get("isolability") or {}
    labels = found.get("labels") or []
    if not labels:
        return {}
    figure = place_figures.isolability(labels, found["cosine"], found.get("absorbed") or [])
    return {"figure": figure, "left": max(len(labels) - place_figures.MOST_LABELS, 0)}


def flexible(d: Diagnosis) -> dict[str, Any]:
    """The flexible residual force: how much better than the named effects it is, on what it depends, where."""
    found = d.details.get("flexible") or {}
    if not found:
        return {}
    seeds = [s for s in found.get("seeds") or [] if finite(s)]
    rows = [("recalibrated simulator", d.gap.calibrated), ("with the named effects", d.gap.with_effects),
            ("flexible force on the recalibrated simulator", found.get("rms_on_base")),
            ("flexible force on top of the named effects", found.get("rms_on_winner"))]  # fmt: skip
    known = [(n, v) for n, v in rows if finite(v)]
    depends = found.get("depends_on") or []
    return {
        "rows": [{"name": n, "value": number(v)} for n, v in known],
        "seeds": f"{number(min(seeds))} – {number(max(seeds))} over {len(seeds)} seeds" if len(seeds) > 1 else "",
        "where": found.get("where") or [], "figure": place_figures.importance(depends) if depends else None,
    }  # fmt: skip


def experiment(d: Diagnosis) -> dict[str, Any]:
    """The next experiment, its command, and the menu with the expected evidence."""
    plan, menu = d.next_experiment, d.details.get("experiments") or []
    own = next((e for e in menu if e.get("name") == plan.get("name")), None) or {}
    command = own.get("command") or {}
    rows = plan.get("table") or [{"experiment": e.get("name"), "evidence": e.get("evidence")} for e in menu]
    heads = list(dict.fromkeys(k for r in rows for k in r)) if all(isinstance(r, Mapping) for r in rows) else []
    return {
        "plan": plan, "evidence": number(plan.get("evidence")) if finite(plan.get("evidence")) else "",
        "figure": gap_figures.commands(command) if command.get("ctrl") and plan else None,
        "heads": heads, "rows": [[cell(r.get(h)) for h in heads] for r in rows] if heads else [],
        "pairs": [{"a": label_title(p["a"]), "b": label_title(p["b"]), "evidence": number(p.get("evidence"))} for p in own.get("pairs") or []],
    }  # fmt: skip


def data(d: Diagnosis) -> dict[str, Any]:
    """Noise per channel and what repeats say."""
    noise = d.details.get("noise") or []
    keys = [k for k in ("channel", "sigma", "quantum", "rest", "highfrequency", "source") if any(k in n for n in noise)]
    again = d.details.get("reproducibility") or {}
    return {
        "heads": keys, "rows": [[cell(n.get(k)) for k in keys] for n in noise],
        "again": [{"name": k.replace("_", " "), "value": cell(v)["text"]} for k, v in again.items()],
    }  # fmt: skip


def cell(value: Any) -> dict[str, Any]:
    """A table's cell: text, and whether it is a number (set to the right)."""
    if isinstance(value, Mapping):
        return {"text": "; ".join(f"{k} {cell(v)['text']}" for k, v in value.items()), "number": False}
    if isinstance(value, list | tuple):
        return {"text": ", ".join(cell(v)["text"] for v in value), "number": False}
    plain = value is None or isinstance(value, str | bool)
    return {"text": ("–" if value is None else str(value)) if plain else number(value), "number": not plain}
