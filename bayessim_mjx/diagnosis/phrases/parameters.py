"""Known parameters in words: at a bound, different between conditions, far from the data sheet or the model."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from bayessim_mjx.diagnosis.data_sheet import ACCURACY
from bayessim_mjx.diagnosis.phrases.effects import CLEAR, any_of, measured
from bayessim_mjx.quantities import MOST, finite, listed, percent

STUCK = "At a bound: {named}. They stand in for something missing, or their ranges are too narrow."
FAR = "Far from the data sheet: {named}."
STANDS_FOR = (
    "These logs do not separate a wrong data sheet at {parameters} from {effects}. To separate them, measure such a "
    "parameter and state it (--accuracy)."
)


def stuck(value: float) -> str:
    """Of a known parameter at its bound."""
    return f"is at its bound {value:.4g}: it stands in for something missing, or its range is too narrow"


def moves(spread: float, groups: int, blocks: bool = False) -> str:
    """Of a known parameter that differs between operating conditions; said in 3 % of checks with nothing hidden."""
    where = "parts of the log" if blocks else "operating conditions"
    return f"differs between {where} (sd {spread:.3g} over {groups}): something may be missing"


def far_from_data_sheet(value: float, away: float) -> str:
    """Of a known parameter whose accuracy was stated."""
    return f"is {value:.4g}, {away:.1f} sd from the data sheet"


def far_from_model(known: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """Return a sentence on known parameters clearly off the model's value, by more than a usual data sheet's error.

    Without it a headline names an effect, and hides that the same fit needs a link with half as much mass again.
    """
    far = []
    for name, p in known.items():
        away, sd = abs(p["mean"] - p["nominal"]), p.get("sd")
        if finite(sd) and away > CLEAR * max(sd, ACCURACY * abs(p["nominal"])):
            far.append(f"{name} is {measured(p['mean'], sd)}, not {p['nominal']:.4g}")
    return [f"In this fit, {listed(far, most=3)}."] if far else []


def less_accurate(found: Mapping[str, tuple[float, float, float]]) -> str:
    """Of kinds of known parameters, {kind: (median, low, high)}, whose accuracy nobody stated."""
    each = [
        f"{kind} about {percent(m)} (90 %: {percent(low)} to {percent(high)})" for kind, (m, low, high) in found.items()
    ]
    return (
        f"the model's numbers are less accurate than usual: {', '.join(each)}; the intervals allow for it; "
        "with --accuracy you state it yourself"
    )


def remarks(known: Mapping[str, Mapping[str, Any]], said: bool = False) -> list[str]:
    """Return a sentence for each suspect parameter, but one for all at a bound and one for all far off.

    said: the headline names effects that do the same as parameters.
    """
    bound = {name: p for name, p in known.items() if p.get("at_bound")}
    far = {name: p for name, p in known.items() if p.get("data_sheet")}
    texts = [f"{name} {p['structural']}." for name, p in known.items() if p["structural"] and name not in bound]
    if len(bound) == 1:
        texts += [f"{name} {p['structural']}." for name, p in bound.items()]
    elif bound:
        texts.append(STUCK.format(named=listed([f"{name} {p['mean']:.4g}" for name, p in bound.items()])))
    if len(far) == 1:
        texts += [f"{name} {p['data_sheet']}." for name, p in far.items()]
    elif far:
        texts.append(FAR.format(named=listed([f"{n} {p['mean']:.4g} ({p['away']:.1f} sd)" for n, p in far.items()])))
    same = standing(known)
    return texts + ([STANDS_FOR.format(parameters=same, effects=stand_ins(known))] if same and not said else [])


def standing(known: Mapping[str, Mapping[str, Any]]) -> str:
    """Name the parameters that effects may stand for, with their values; "" without any."""
    return listed([f"{name} ({p['mean']:.4g})" for name, p in known.items() if p.get("same_as")], most=MOST)


def stand_ins(known: Mapping[str, Mapping[str, Any]]) -> str:
    """Name the effects that do the same in the logs as known parameters far from the data sheet; "" without any."""
    labels = dict.fromkeys(label for p in known.values() for label in p.get("same_as") or ())
    return any_of(list(labels), MOST) if labels else ""
