"""Effects in words: names, places and numbers, and explanations that the logs do not separate."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from scipy.special import ndtri

from bayessim_mjx import effects as library
from bayessim_mjx import quantities
from bayessim_mjx.diagnosis.correction import Estimate, FoundEffect
from bayessim_mjx.diagnosis.selection.numbers import ODDS
from bayessim_mjx.effects.support.words import half_of, spelt, words
from bayessim_mjx.quantities import MOST, finite, listed, percent

if TYPE_CHECKING:
    from bayessim_mjx.diagnosis.selection.bounds import Bound


CONTAINS = "contains it as a special case and explains no more"
NO_GAIN = "no gain at first order"  # why effects were not fitted
LESS_PROMISING = "less promising than those that were fitted"
NO_TIME_LEFT = "no time left"
NOTHING_LEFT = "the known parameters leave too little to explain"
NOT_SCREENED = "no time to screen them"
UNKNOWN = "is not identified by these logs"
# quantities that are easier to read as their reciprocal
RECIPROCALS = {
    "inverse_limit": "limit",
    "inverse_stall": "stall effort",
    "inverse_speed": "no-load speed",
    "slowness": "largest rate",
}
WRONG = "the true "  # begins the words for an effect whose number the simulator has, but not right
# standard deviations, 1.98: the odds of a normal number against so large a chance deviation are strong (`Odds.strong`);
# false reports of fitted values were not counted
CLEAR = -float(ndtri(0.5 / (1.0 + ODDS.strong)))


def titled(name: str, where: str) -> str:
    """`extra payload at tool`, on its own."""
    return words(name).at(where)


def by_law(effects: Iterable[Sequence[str]]) -> list[str]:
    """Return a phrase for each law, (name, place) given: `Coulomb friction at shoulder and elbow`."""
    places: dict[str, list[str]] = {}
    for name, where in effects:
        places.setdefault(name, []).append(where)
    own = {name: [w for w in where if w not in ("", "world", "all")] for name, where in places.items()}
    some = {name: [listed(at)] if len(at) > 1 else at for name, at in own.items()}
    tied = {name: [w for w in where if w in ("", "world", "all")] for name, where in places.items()}
    return [titled(name, where) for name in places for where in [*some[name], *tied[name]]]


def any_of(labels: Sequence[str], most: int | None = None) -> str:
    """`command delay or actuator lag at motor`, of "name@place"; the place once where all have the same."""
    pairs = [(name, where) for name, _, where in (label.partition("@") for label in labels)]
    same = {(where, words(name).kind) for name, where in pairs}
    if len(pairs) > 1 and len(same) == 1:
        return words(pairs[0][0]).at(pairs[0][1], listed([words(name).noun for name, _ in pairs], "or", most))
    return listed(by_law(pairs), "or", most)


def all_of(effects: Iterable[Sequence[str]]) -> str:
    """`load friction at elbow and command delay at elbow_motor`, of (name, place); of none the known parameters."""
    return listed(by_law(effects)) or "the known parameters alone"


def measured(mean: Any, sd: Any = None, unit: str = "") -> str:
    """`0.1497 +- 0.0087 N m`, rounded by its standard deviation; times below a second in ms."""
    if unit == "s" and finite(mean) and abs(mean) < 1:
        mean, sd, unit = 1e3 * mean, 1e3 * sd if finite(sd) else sd, "ms"
    text = quantities.estimate(mean, sd if finite(sd) else float("nan")).replace("±", "+-")
    return f"{text} {unit}".rstrip()


def multiplied(model: float, mean: float, sd: float | None) -> str:
    """`7.27 +- 0.06, not 20`, of a multiple of a number that the model or the logs have."""
    return f"{measured(model * mean, None if sd is None else model * sd)}, not {model:g}"


def spanned(mean: float, low: float, high: float, unit: str) -> str:
    """`4.76 ms (90 %: 4.21 to 5.30)`, rounded by the width of the interval."""
    if unit == "s" and abs(mean) < 1:
        mean, low, high, unit = 1e3 * mean, 1e3 * low, 1e3 * high, "ms"
    places = quantities.DIGITS - 1 - quantities.power(high - low)
    size, least, most = (quantities.fixed(x, places) for x in (mean, low, high))
    return f"{size} {unit} (90 %: {least} to {most})"


def quantity(name: str, value: Estimate, effect: str = "") -> tuple[str, str]:
    """Return a parameter's name and value; reciprocals turned over (`inverse_limit` 0.5 1/(N m) -> limit 2 N m).

    Args:
        effect: whose parameter it is, so that a half is called one (`effects.support.words.spelt`).
    """
    if name in RECIPROCALS and finite(value.mean) and value.mean > 0:
        mean, bound = value.mean, value.bound
        sd: float | None = value.sd
        if finite(sd) and mean < CLEAR * sd:  # may be 0, and its reciprocal infinite
            mean, sd, bound = mean + CLEAR * sd, None, "at most"
        sd = sd / mean**2 if finite(sd) else sd  # d(1/x) = dx / x^2
        over, _, under = value.unit.partition("/")
        under = under.removeprefix("(").removesuffix(")")
        unit = under if over in ("1", "") else f"{under}/{over}"
        turned = {"at least": "at most", "at most": "at least"}.get(bound, bound)
        return RECIPROCALS[name], _bounded(measured(1 / mean, sd, unit), turned)
    return spelt(name, effect), _bounded(measured(value.mean, value.sd, value.unit), value.bound)


def _bounded(text: str, bound: str) -> str:
    """Return a value that ends at a bound (`Estimate.bound`)."""
    if bound in ("at least", "at most"):
        return f"{bound} {text}"
    return text + {"off": " (off)", "end": " (end of its range)"}.get(bound, "")


def numbered(effect: FoundEffect) -> str:
    """Name an effect with its place and numbers: `a command delay of 12.1 +- 0.4 ms at motor`.

    Of several numbers those that are clearly away from neutral; the table has all.
    """
    own = words(effect.name)
    name = own.noun if own.lacks.startswith(WRONG) else own.lacks
    main = _main(effect)
    if len(main) == 1:
        return own.at(effect.where, f"{name} of {_size(effect)}")
    numbers = _numbers(effect)
    return own.at(effect.where, name) + (f" ({numbers})" if numbers else "")


def _size(effect: FoundEffect) -> str:
    """Return the one number of an effect; of a half also the whole: `0.02 rad to either side (0.04 rad in all)`."""
    ((name, value),) = _main(effect).items()
    text = quantity(name, value)[1]
    if not half_of(effect.name, name) or value.bound == "off":
        return text
    return f"{text} to either side ({quantities.number(2 * value.mean)} {value.unit}".rstrip() + " in all)"


def _main(effect: FoundEffect) -> dict[str, Estimate]:
    """Return an effect's numbers without optional ones, such as the softness of MuJoCo's friction."""
    kind = library.known(effect.name)
    optional = {q.name for q in kind.quantities if q.optional} if kind else set()
    return {k: v for k, v in effect.parameters.items() if k not in optional}


def _numbers(effect: FoundEffect) -> str:
    """Return the numbers that are clearly away from neutral; a shape's only where the amounts that it shapes are."""
    kind, main = library.known(effect.name), _main(effect)
    shapes = {q.name for q in kind.quantities if q.shape} if kind else set()
    clear = {k: quantity(k, v, effect.name) for k, v in main.items() if _clear(effect.name, k, v)}
    sure = all(k in clear or k in shapes for k in main)
    return ", ".join(" ".join(text) for k, text in clear.items() if sure or k not in shapes)


def _clear(effect: str, name: str, value: Estimate) -> bool:
    """Whether a number is clearly away from the value that switches its effect off."""
    kind = library.known(effect)
    neutral = {q.name: q.neutral for q in kind.quantities}.get(name, 0.0) if kind else 0.0
    away = finite(value.mean) and abs(value.mean - neutral)
    return bool(away) and value.bound != "off" and (not finite(value.sd) or away > CLEAR * value.sd)


def wrong(effect: FoundEffect) -> str:
    """Return `the actuator gain at torque is 0.698 +- 0.036, not 1`, of an effect that corrects a number; else ""."""
    kind, own = library.known(effect.name), words(effect.name)
    if kind is None or not own.lacks.startswith(WRONG):
        return ""
    name = own.at(effect.where, own.lacks.removeprefix(WRONG))
    if len(effect.parameters) != 1:
        numbers = _numbers(effect)
        return f"the {name} is not the model's" + (f" ({numbers})" if numbers else "")
    ((own_name, number),) = effect.parameters.items()
    (_, value), neutral = quantity(own_name, number), kind.quantities[0].neutral
    if not (number.bound or _clear(effect.name, own_name, number)):
        return f"the {name} is uncertain ({value}; the model has {neutral:g})"
    if kind.relative:
        (factor,) = effect.parameters.values()
        model = next(iter(effect.modelled.values()), math.nan)
        if factor.bound or not finite(model):
            return f"the {name} is {value} times the model's"
        return f"the {name} is {multiplied(model, factor.mean, factor.sd)}"
    return f"the {name} is {value}, not {neutral:g}" if neutral else f"the {name} is off by {value}"


def lacking(effects: Sequence[FoundEffect]) -> str:
    """Return `the simulator lacks ...; the actuator gain at torque is ...`: each effect with its place and numbers."""
    laws: dict[str, list[FoundEffect]] = {}
    for e in (e for e in effects if not wrong(e)):
        laws.setdefault(e.name if len(_main(e)) == 1 else f"{e.name}@{e.where}", []).append(e)
    lacks = listed([_law(own) for own in laws.values()])
    parts = [f"the simulator lacks {lacks}"] if lacks else []
    return "; ".join([*parts, *(text for e in effects if (text := wrong(e)))])


def _law(effects: Sequence[FoundEffect]) -> str:
    """One law with its places: `Coulomb friction of 0.15 +- 0.01 N m at shoulder and 0.12 +- 0.01 N m at elbow`."""
    if len(effects) == 1:
        return numbered(effects[0])
    own = words(effects[0].name)
    each = [own.at(e.where, _size(e)) for e in effects]
    return f"{own.lacks} of {listed(each, most=MOST)}"


def line(effect: FoundEffect) -> str:
    """`Coulomb friction at hinge: 0.1497 +- 0.0087 N m`, for a list; several parameters by name."""
    found = [quantity(k, v, effect.name) for k, v in effect.parameters.items()]
    values = [_size(effect)] if len(found) == 1 else [f"{k} {v}" for k, v in found]
    return capital(titled(effect.name, effect.where)) + (": " + ", ".join(values) if values else "")


def answer(effect: FoundEffect, found: Mapping[str, Any]) -> str:
    """One answer with its identifiable number, where several explanations predict these logs alike.

    `These logs fit 2 explanations alike: 4.76 ms (90 %: 4.21 to 5.30) on the command's way, by command delay or
    actuator lag at motor.`

    Args:
        effect: the named one; found: its entry of `Diagnosis.answers`.
    """
    each, number = [m["effects"] for m in found["members"]], found["number"]
    titles = [listed(by_law(label.split("@", 1) for label in m), "with") for m in each]
    if not number:
        text = f"{listed([numbered(effect), *titles[1:]], 'or')}"
    else:
        size = spanned(number["mean"], number["low"], number["high"], number["unit"])
        rest = [title for title, m in zip(titles, each, strict=True) if m[1:] or m[0] not in number["effects"]]
        text = f"{size}{_way(number)}, by {any_of(number['effects'])}"
        text += f". With another number: {listed(rest, 'or')}" if rest else ""
    return f"These logs fit {len(each)} explanations alike: {text}."


def _way(number: Mapping[str, Any]) -> str:
    """Where a time is lost, of effects that all shift time."""
    if number["unit"] != "s":
        return ""
    kinds = {words(label.partition("@")[0]).kind for label in number["effects"]}
    ways = {"actuator": " on the command's way", "joint": " on the measurement's way"}
    return ways[kinds.pop()] if len(kinds) == 1 and kinds <= set(ways) else " between command and measurement"


def close_by(nats: float, behind: float) -> str:
    """Why a model is a rival: how little evidence and closure separate it from the named one."""
    return f"held-out evidence differs by {nats:.1f} nats, {percent(max(behind, 0.0))} of the gap"


def at_bound(bound: Bound, unit: str) -> str:
    """Say that a parameter ends at a bound; a clause, after the parameter's name."""
    if bound.kind == "off":
        return f"is {bound.at:.3g}: it has no part in the effect"
    value = f"{bound.at:.3g} {unit}".rstrip()
    if bound.kind == "end":
        further = f"ends at its bound {value}; a wider range explains no more"
        return f"ends at {value}, the physical limit" if bound.physical else further
    which = "largest" if bound.kind == "at least" else "smallest"
    return f"ends at {value}, the {which} value tried: {bound.kind} this, or another law is behind it"


def not_on_offer(tried: Iterable[str]) -> str:
    """Effects that are tried only if they are named, in words; "" if all were. tried: names of effects."""
    kinds = ((name, library.load(name)) for name in library.names())
    names = [name for name, kind in kinds if not (kind.offered or kind.random) and name not in set(tried)]
    nouns = listed([words(name).noun for name in names])
    return f"Not tried because not named: {nouns} (--effects all,{','.join(names)})." if names else ""


def label_title(label: str, short: bool = False) -> str:
    """`coulomb_friction@elbow` -> `Coulomb friction at elbow`, or in short `Coulomb friction · elbow`."""
    name, _, where = str(label).partition("@")
    if short and where:
        return f"{capital(words(name).noun)} · {where}"
    return capital(titled(name, where)) if where or words(name).kind else str(label)


def candidate_title(candidate: Mapping[str, Any]) -> str:
    """`Coulomb friction · elbow, wrist + Command delay · motor`: each law once, with its places."""
    places: dict[str, list[str]] = {}
    for label in candidate.get("effects") or []:
        law, _, place = label_title(label, short=True).partition(" · ")
        places.setdefault(law, []).append(place)
    titles = [" · ".join(filter(None, (law, ", ".join(filter(None, at))))) for law, at in places.items()]
    return " + ".join(titles) or str(candidate.get("label") or "no effect")


def capital(text: str) -> str:
    """With a capital letter at the front."""
    return f"{text[:1].upper()}{text[1:]}"
