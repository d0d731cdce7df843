"""The whole answer of a check: its findings, look-alikes among its mistakes, and what it was made with."""

from __future__ import annotations

import dataclasses
import json
import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from bayessim_mjx import atomic
from bayessim_mjx.blind import amounts, show
from bayessim_mjx.blind.cases import ITEM, Item, again
from bayessim_mjx.blind.check import WIDEST, Bench, Check, bench
from bayessim_mjx.blind.curves import Curves
from bayessim_mjx.blind.outcome import VERDICTS, Outcome, alarm, covered, label, rate
from bayessim_mjx.blind.process import apart as apart_here
from bayessim_mjx.blind.reality.lookalikes import APART, apart
from bayessim_mjx.blind.reality.menu import KNOWN, places
from bayessim_mjx.blind.reality.plant import Rig
from bayessim_mjx.blind.reality.strength import Ruler
from bayessim_mjx.blind.recall import FILE
from bayessim_mjx.blind.robot import motions
from bayessim_mjx.blind.runner import trials
from bayessim_mjx.errors import UserError
from bayessim_mjx.quantities import count
from bayessim_mjx.versions import versions

__all__ = ["FILE", "about", "answer", "lookalikes", "write"]
PAIRS = 6  # looked at, for the time: each is simulated in every motion of the menu
Say = Callable[[str, int, int], None]
Pair = tuple[str, str, str, str]  # hidden effect and place, said effect and place


def answer(check: Check, outcomes: Sequence[Outcome], say: Say | None = None) -> Found:
    """Make the contents of blind.json; without `say` (before the end) no look-alikes are searched: they take long."""
    own = bench(check)
    found = findings(outcomes, own, check.effects)
    found["lookalikes"] = lookalikes(check, own, outcomes, say) if say else []
    settings = {k: v for k, v in dataclasses.asdict(check).items() if k != "out"}
    return found | {"looked": say is not None, "versions": versions(), "settings": settings}


def write(check: Check, found: Found) -> None:
    """blind.json and the page."""
    atomic.write_text(check.folder / FILE, json.dumps(found, indent=1, default=float))
    show.page(found, about(check), check.folder)


def about(check: Check) -> list[str]:
    """Robot, logs, seed and entry, for the head of the page."""
    source = count(len(check.data), "log path") if check.data else "a menu of motions"
    entry = [f"entry: {check.command}"] if check.command else []
    by = "Landlock" if check.sandbox and apart_here() else "its folder alone"
    kept = f"the diagnosis is kept from the truths by {by}"
    return [
        check.name,
        source,
        f"data-sheet values within {100 * check.accuracy:g} %",
        f"seed {check.seed}",
        kept,
        *entry,
    ]


def lookalikes(check: Check, own: Bench, outcomes: Sequence[Outcome], say: Say) -> list[dict[str, Any]]:
    """Of the pairs that were mistaken: those that these experiments leave within a noise, and what parts them."""
    pairs: Counter[Pair] = Counter()
    example: dict[Pair, Outcome] = {}
    for o in sorted(outcomes, key=lambda o: o.truth["strength"]):
        if o.kind == "single" and not o.right(o.truth["effects"][0]) and (rival := _rival(o, own)):
            pair = (o.truth["effect"], o.truth["where"], *rival)
            pairs[pair] += 1
            example[pair] = o  # the strongest
    out = []
    for k, (pair, _) in enumerate(pairs.most_common(PAIRS)):
        say("look-alikes", k, min(len(pairs), PAIRS))
        truth = example[pair].truth
        cause = again(check, own, Item(**{key: truth[key] for key in ITEM}), truth["effects"][0]["size"])
        left = apart(cause, pair[2], pair[3], own.ruler)
        if left < APART:
            best, by = _excitation(check, own, cause, pair)
            names = dict(zip(("hidden", "where", "rival", "rival_where"), pair, strict=True))
            out.append(names | {"left": left, "excitation": best, "by": by})
    return out


def _rival(o: Outcome, own: Bench) -> tuple[str, str] | None:
    """Find the effect that was named in the place of the truth, as a cause of the finer reality."""
    said = o.named()
    if not said or said[0]["name"] not in KNOWN:
        return None
    spots = places(own.ruler.system, said[0]["name"], own.scales)
    asked = {own.joint(w) for w in str(said[0]["where"]).replace("+", ",").split(",")}
    near = [w for w in spots if own.joint(w) in asked] or spots
    found = (said[0]["name"], near[0]) if near else None
    return None if found == (o.truth["effect"], o.truth["where"]) else found


def _excitation(check: Check, own: Bench, cause: Any, pair: Pair) -> tuple[str, float]:
    """Choose the motion of the menu that parts a pair best, and by how many noises; "" where none parts it."""
    try:
        menu = motions(own.load, check.name, tuple(np.asarray(own.rig.sigma)))
    except UserError:  # a robot that no motion can be proposed for
        return "", 0.0
    base = dict.fromkeys(own.ruler.base, 1.0)
    found = [(apart(cause, pair[2], pair[3], _ruler(rig, base, check)), name) for name, rig in menu.items()]
    by, name = max((f for f in found if np.isfinite(f[0])), default=(0.0, ""))
    return (name, by) if by > APART else ("", by)


def _ruler(rig: Rig, base: dict[str, float], check: Check) -> Ruler:
    return Ruler(rig, base, WIDEST * check.accuracy, check.seed)


# From outcomes to the answer: thresholds in physical units, mistakes, rates, and sentences


# rules of thumb, not measured
STEEP = (0.3, 2.0)  # how an amount may grow with strength: its power, 1 where effects act in proportion
SHARP = 15.0  # largest strength over smallest of an interval that gets a sentence
PLOTTED = np.geomspace(1.0, 300.0, 41)
Found = dict[str, Any]


def findings(outcomes: Sequence[Outcome], own: Bench, effects: tuple[str, ...]) -> Found:
    """Make the answer as it is written to blind.json."""
    curves = Curves(trials(outcomes))
    singles = [o for o in outcomes if o.kind == "single" and o.said]
    rows = [_threshold(g, curves, singles, own) for g in own.groups(effects)]
    nulls = [o for o in outcomes if o.kind == "null" and o.said]
    unknown = [o for o in outcomes if o.kind == "unknown" and o.said]
    found = {
        "cases": len(outcomes),
        "failed": sum(o.said is None for o in outcomes),
        "seconds": float(np.median([o.seconds for o in outcomes])) if outcomes else math.nan,
        "cpu": float(np.mean([o.cpu for o in outcomes])) if outcomes else math.nan,
        "thresholds": rows,
        "curves": _curves(curves, effects or tuple(dict.fromkeys(e for e, _ in own.groups(effects)))),
        "trials": [vars(t) for t in trials(outcomes)],
        "found": rate([o.right(e) for o in singles for e in o.truth["effects"]]),
        "in_the_set": rate([o.inside(e) for o in singles for e in o.truth["effects"]]),
        "false_alarms": rate([alarm(o) for o in nulls]),
        "unknown_unexplained": rate([label(o) == "unexplained" for o in unknown]),
        "coverage": rate([c for o in singles for c in covered(o)]),
        "closure": closure(singles),
        "really_closed": _really_closed(singles),
        "confusion": _confusion(outcomes),
        "mistaken": mistaken(singles),
    }
    return found | {"sentences": sentences(found)}


def _threshold(group: tuple[str, str], curves: Curves, singles: Sequence[Outcome], own: Bench) -> Found:
    effect, where = group
    tried = [(o, e) for o in singles for e in o.truth["effects"] if (e["name"], e["where"]) == group]
    middle, low, high = curves.of(effect, where).interval()
    strongest = max(curves.all_of(effect), key=lambda t: t.strength, default=None)
    most = strongest.strength if strongest else 0.0
    pairs = [(e["strength"], e["amount"]) for _, e in tried if e["strength"] > 0 and e["amount"] > 0]
    slide = own.slide(effect, where)
    found: Found = {
        "effect": effect, "where": where, "tried": len(tried), "found": sum(o.right(e) for o, e in tried),
        "strength": [middle, low, high], "largest": most,
        "beyond": strongest is not None and not strongest.found and middle > most,
        "unit": amounts.unit_of(effect, slide), "amount": None, "told": "", "interval": "",
    }  # fmt: skip
    if pairs:
        at = [amount_at(s, pairs) for s in (middle, low, high, most)]
        found["amount"] = at[:3]
        words = [amounts.in_words(effect, a, slide) for a in at]
        sign = "<" if amounts.AMOUNTS.get(effect, amounts.OTHER).inverse else ">"
        found["told"] = f"{sign} {words[3]}" if found["beyond"] else words[0]
        found["interval"] = "not reached" if found["beyond"] else f"{words[1]} to {words[2]}"
    return found


def amount_at(strength: float, pairs: Sequence[tuple[float, float]]) -> float:
    """Convert a strength of an effect to its amount, by a power law through (strength, amount) of its cases."""
    x, y = np.log(np.array(pairs, float)).T
    power = 1.0
    if len(x) > 1 and np.ptp(x) > 0.7:
        power = float(np.clip(np.polyfit(x, y, 1)[0], *STEEP))
    return float(np.exp(np.median(y - power * x) + power * math.log(max(strength, 1e-9))))


def _curves(curves: Curves, effects: Sequence[str]) -> Found:
    """{effect: [strength, chance, low, high]} of an effect at a place where it was not tried yet."""
    out = {}
    for effect in effects:
        if curves.all_of(effect):
            columns = (PLOTTED, *curves.of(effect, "").curve(PLOTTED))
            out[effect] = [[round(float(v), 4) for v in c] for c in columns]
    return out


def closure(singles: Sequence[Outcome]) -> Found:
    """Shares of the gap that diagnoses with the right effect say they close: median and 90 % range, and how many."""
    said = [(o.said or {}).get("gap", {}).get("closed", {}).get("realised") for o in singles if _all_right(o)]
    return _spread([float(s) for s in said if s is not None])


def _really_closed(singles: Sequence[Outcome]) -> Found:
    closed = [o.truth.get("closed") for o in singles if _all_right(o)]
    return _spread([float(c) for c in closed if c is not None])


def _spread(known: Sequence[float]) -> Found:
    if not known:
        return {"n": 0}
    low, middle, high = np.quantile(known, (0.05, 0.5, 0.95))
    return {"n": len(known), "median": float(middle), "low": float(low), "high": float(high)}


def _all_right(o: Outcome) -> bool:
    return all(o.right(e) for e in o.truth["effects"])


def mistaken(singles: Sequence[Outcome]) -> dict[str, dict[str, int]]:
    """{hidden effect: {what was said in its place: how often}}."""
    found: dict[str, Counter[str]] = {}
    for o in singles:
        for e in o.truth["effects"]:
            if not o.right(e):
                found.setdefault(e["name"], Counter())[_instead(o, e)] += 1
    return {name: dict(c.most_common()) for name, c in sorted(found.items())}


def _instead(o: Outcome, effect: Mapping[str, Any]) -> str:
    said = label(o)
    return f"{said} elsewhere" if said == effect["name"] else said


def _confusion(outcomes: Sequence[Outcome]) -> Found:
    pairs: Counter[tuple[str, str]] = Counter()
    for o in outcomes:
        hidden = next((e["name"] for e in o.truth["effects"]), "nothing")
        pairs[hidden, label(o)] += 1
    rows = sorted({h for h, _ in pairs}, key=lambda h: (h == "nothing", h.startswith("unknown"), h))
    said = {s for _, s in pairs}
    columns = [*sorted(said - set(VERDICTS)), *(v for v in VERDICTS if v in said)]
    return {"rows": rows, "columns": columns, "counts": [[pairs[r, c] for c in columns] for r in rows]}


def sentences(found: Found, most: int = 6) -> list[str]:
    """Write the effects that would have been missed, clearest first, for the report of a diagnosis of the same logs."""
    rows = [r for r in found["thresholds"] if r["amount"] and r["tried"]]
    rows.sort(key=lambda r: math.log(r["strength"][2] / r["strength"][1]))
    sharp = [r for r in rows[:most] if r["strength"][2] < SHARP * r["strength"][1]]
    return [sentence(r) for r in sharp] or ["too few cases to say what would be missed: go on with more of them"]


def sentence(r: Mapping[str, Any]) -> str:
    amount = amounts.AMOUNTS.get(r["effect"], amounts.OTHER)
    name = amounts.spoken(r["effect"]) + ("" if r["where"] in ("world", "") else f" at {r['where']}")
    side, bound = "above" if amount.inverse else "under", r["told"].lstrip("<> ")
    if r["beyond"]:
        return f"{name}: even {bound} ({amount.what}), the strongest that was tried, was not seen"
    return (
        f"{name} {side} {bound} ({amount.what}) would not have been seen reliably: it is found 9 times of 10 from "
        f"there on (90 % interval {r['interval']})"
    )
