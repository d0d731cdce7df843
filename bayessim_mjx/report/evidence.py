"""Sections with evidence: overlays, parameters, isolability, the flexible force, the next experiment, noise."""

from collections.abc import Mapping
from typing import Any

from bayessim_mjx.diagnosis.phrases.effects import label_title
from bayessim_mjx.diagnosis.phrases.residual import beside_effects
from bayessim_mjx.diagnosis.result import Diagnosis
from bayessim_mjx.diagnosis.statistics import Z90
from bayessim_mjx.quantities import finite, unit
from bayessim_mjx.report import marks, motion_figures, rival_figures
from bayessim_mjx.report.choice import choice
from bayessim_mjx.report.look import STAGE
from bayessim_mjx.report.words import accuracy, estimate, known_span, length, number, percent

OVERLAY_NUMBERS = 90_000  # in all overlays together, so that the page stays a few MB
FEWEST_POINTS = 200
EVIDENCE = 2  # digits of an expected evidence; no source: a matter of style
SIZES = ("sigma", "quantum", "rest", "highfrequency")  # of a channel's noise, in its unit


def overlays(d: Diagnosis) -> dict[str, Any]:
    """Measured against simulated by log and joint, and every log's gap; beyond the budget the smallest go."""
    rows = [_told(d, row) for row in d.details.get("overlays") or []]
    most = max(OVERLAY_NUMBERS // (8 * FEWEST_POINTS), 1)
    kept = rows if len(rows) <= most else sorted(rows, key=_worst, reverse=True)[:most]
    points = max(FEWEST_POINTS, min(2000, OVERLAY_NUMBERS // (8 * max(len(kept), 1))))
    keys = [(str(r.get("log", "")), str(r.get("joint", ""))) for r in kept]
    panels = [(key, motion_figures.overlay(r, points)) for key, r in zip(keys, kept, strict=True) if len(r["time"])]
    lines = [_told(d, row) for row in d.details.get("episodes") or []]
    return {
        "choice": choice(["log", "joint"], panels),
        "left": len(rows) - len(kept),
        "episodes": motion_figures.episodes(lines[:60]) if lines else None,
    }


def _told(d: Diagnosis, row: Mapping[str, Any]) -> dict[str, Any]:
    """Return a row of motion or gaps; without effects nothing that was simulated with them."""
    return {k: v for k, v in row.items() if k != "with_effects" or d.effects}


def _worst(row: Mapping[str, Any]) -> float:
    pairs = zip(row["measured"], row.get("nominal") or [], strict=False)
    return max((abs(a - b) for a, b in pairs if finite(a) and finite(b)), default=0.0)


def parameters(d: Diagnosis) -> dict[str, Any]:
    """Recalibrated parameters in their ranges, and their estimates per operating condition."""
    rows, known = [], next((c for c in d.candidates if not c.get("effects")), {}) if d.effects else {}
    for name, p in d.parameters.items():
        mean, sd = p.get("mean"), p.get("sd")
        ranged = known_span((p.get("low"), p.get("high")))
        limits = ranged or marks.scale_of([mean, p.get("nominal")], zero=False)
        ci = (mean - Z90 * sd, mean + Z90 * sd) if finite(mean) and finite(sd) else None
        colour = STAGE["nominal"] if p.get("structural") else STAGE["with_effects"]
        rows.append(
            {
                "name": name,
                "nominal": number(p.get("nominal")),
                "value": estimate(mean, sd),
                "alone": number((known.get("parameters") or {}).get(name)) if known else "",
                "unit": unit(p.get("unit") or ""),
                "structural": p.get("structural") or "",
                "data_sheet": p.get("data_sheet") or "",
                "low": number(ranged[0]) if ranged else "",
                "high": number(ranged[1]) if ranged else "",
                "mark": marks.interval(mean, ci, limits, colour, (p.get("nominal"),), width=150),
            }
        )
    found = d.details.get("groups") or {}
    estimates = found.get("parameters") or {} if found.get("names") else {}
    moves = sorted(estimates, key=lambda k: not d.parameters.get(k, {}).get("structural"))
    drawn = {k: _of_robot(estimates[k], d.parameters.get(k, {})) for k in moves}
    figure = rival_figures.groups(found["names"], drawn, d.parameters) if moves else None
    names = found.get("names") or []
    numbered = [] if rival_figures.fits(names) else names
    left = max(len(moves) - 12, 0)
    return {
        "rows": rows,
        "alone": bool(known),
        "accuracy": accuracy(d),
        "groups": figure,
        "numbered": numbered,
        "left": left,
    }


def _of_robot(row: Mapping[str, Any], known: Mapping[str, Any]) -> dict[str, Any]:
    """Move estimates per condition from the simulated value to the robot's, which the table has."""
    own, simulated = known.get("mean"), known.get("simulated")
    move = own - simulated if finite(own) and finite(simulated) else 0.0
    return {**row, "mean": [m + move if finite(m) else m for m in row["mean"]]}


def isolability(d: Diagnosis) -> dict[str, Any]:
    found = d.details.get("isolability") or {}
    labels = found.get("labels") or []
    if not labels:
        return {}
    figure = rival_figures.isolability(labels, found["cosine"], found.get("absorbed") or [])
    return {"figure": figure, "left": max(len(labels) - rival_figures.MOST_LABELS, 0)}


def flexible(d: Diagnosis) -> dict[str, Any]:
    """Return the flexible residual force: how much better than the named effects, its inputs and its places."""
    found = d.details.get("flexible") or {}
    if not found:
        return {}
    seeds: list[float] = [s for s in found.get("seeds") or [] if finite(s)]
    rows = [
        ("recalibrated simulator", d.gap.calibrated),
        ("with the named effects", d.gap.with_effects if d.effects else None),
        ("flexible force on the recalibrated simulator", found.get("rms_on_base")),
        ("flexible force on top of the named effects", found.get("rms_on_winner") if d.effects else None),
    ]
    known = [(n, v) for n, v in rows if finite(v)]
    depends = found.get("depends_on") or []
    return {
        "rows": [{"name": n, "value": number(v)} for n, v in known],
        "seeds": f"{number(min(seeds))} – {number(max(seeds))} over {len(seeds)} seeds" if len(seeds) > 1 else "",
        "where": found.get("where") or [],
        "beside": beside_effects(d),
        "figure": rival_figures.importance(depends) if depends else None,
    }


def black_boxes(d: Diagnosis) -> dict[str, Any]:
    """Return the shares that a network and a formula close of the gap, beside the named effects."""
    found = d.details.get("black_boxes") or {}
    names = {"named_effects": "the named effects", "network": "a small network", "formula": "a sparse formula"}
    shares = [(text, found.get(key)) for key, text in names.items()]
    rows = [{"name": text, "share": percent(min(max(v, 0.0), 1.0))} for text, v in shares if finite(v)]
    return {"rows": rows, "formula": found.get("formula_in_words") or []} if rows else {}


def experiment(d: Diagnosis) -> dict[str, Any]:
    """Return the next experiment, its command, and the menu with the expected evidence."""
    plan, menu = d.next_experiment, d.details.get("experiments") or []
    own = next((e for e in menu if e.get("name") == plan.get("name")), None) or {}
    command = own.get("command") or {}
    rows = plan.get("table") or [{"experiment": e.get("name"), "evidence": e.get("evidence")} for e in menu]
    heads = list(dict.fromkeys(k for r in rows for k, v in r.items() if v not in ("", None)))
    pairs = [(label_title(p["a"]), label_title(p["b"]), number(p.get("evidence"))) for p in own.get("pairs") or []]
    return {
        "plan": plan,
        "evidence": number(plan.get("evidence"), EVIDENCE) if finite(plan.get("evidence")) else "",
        "figure": motion_figures.commands(command) if command.get("ctrl") and plan else None,
        "heads": heads,
        "rows": [[_planned(r.get(h), h) for h in heads] for r in rows] if heads else [],
        "pairs": [dict(zip(("a", "b", "evidence"), p, strict=True)) for p in pairs],
    }


def _planned(value: Any, head: str) -> dict[str, Any]:
    """Return a cell of the menu; the evidence that is expected is known to few digits."""
    return {"text": number(value, EVIDENCE), "number": True} if head == "evidence" and finite(value) else cell(value)


def data(d: Diagnosis) -> dict[str, Any]:
    """Noise per channel and what repeats say."""
    noise = d.details.get("noise") or []
    keys = [k for k in ("channel", "sigma", "quantum", "rest", "highfrequency", "source") if any(k in n for n in noise)]
    again = d.details.get("reproducibility") or {}
    units = {name: row["unit"] for name, row in d.gap.physical.items() if row.get("unit")}

    def shown(row: Mapping[str, Any], key: str) -> dict[str, Any]:
        """Return a cell; a size in degrees or millimetres where the channel's unit is known."""
        own, value = units.get(row.get("channel", "")), row.get(key)
        return {"text": length(value, own), "number": True} if own and key in SIZES and finite(value) else cell(value)

    return {
        "heads": keys,
        "rows": [[shown(n, k) for k in keys] for n in noise],
        "again": [{"name": k.replace("_", " "), "value": cell(v)["text"]} for k, v in again.items()],
    }


def cell(value: Any) -> dict[str, Any]:
    """Return a table's cell: text, and whether it is a number (set to the right)."""
    if isinstance(value, Mapping):
        return {"text": "; ".join(f"{k} {cell(v)['text']}" for k, v in value.items()), "number": False}
    if isinstance(value, list | tuple):
        return {"text": ", ".join(cell(v)["text"] for v in value), "number": False}
    plain = value is None or isinstance(value, str | bool)
    return {"text": ("–" if value is None else str(value)) if plain else number(value), "number": not plain}
