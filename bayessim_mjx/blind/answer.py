"""The whole answer of a check: its findings, look-alikes among its mistakes, and what it was made with."""

import dataclasses
import json
from collections import Counter
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from bayessim_mjx import atomic
from bayessim_mjx.blind import show
from bayessim_mjx.blind.cases import ITEM, Item, again
from bayessim_mjx.blind.check import WIDEST, Bench, Check, bench
from bayessim_mjx.blind.findings import Found, findings
from bayessim_mjx.blind.outcome import Outcome
from bayessim_mjx.blind.process import apart as apart_here
from bayessim_mjx.blind.reality.lookalikes import APART, apart
from bayessim_mjx.blind.reality.menu import KNOWN, places
from bayessim_mjx.blind.reality.plant import Rig
from bayessim_mjx.blind.reality.strength import Ruler
from bayessim_mjx.blind.recall import FILE
from bayessim_mjx.blind.robot import motions
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
