"""A diagnosis in plain English: effects, places, units, numbers with sensible digits, verdicts and what to do next."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from bayessim_mjx import quantities
from bayessim_mjx.diagnosis.gap import of_rms
from bayessim_mjx.diagnosis.result import Diagnosis, Estimate, FoundEffect
from bayessim_mjx.effects.support.words import words
from bayessim_mjx.quantities import finite, typeset, unit

MISSING = quantities.MISSING  # where there is no number
WIDE = 1000  # an interval of a gap whose ends differ by more is not told in numbers

# quantities that are easier to read as their reciprocal
RECIPROCALS = {
    "inverse_limit": "limit",
    "inverse_stall": "stall effort",
    "inverse_speed": "no-load speed",
    "slowness": "largest rate",
}
STAGES = {
    "nominal": "as delivered",
    "calibrated": "recalibrated",
    "with_effects": "with effects",
    "reducible_floor": "reducible floor",
    "noise_floor": "noise floor",
}


@dataclass(frozen=True)
class Verdict:
    """Badge text, one sentence where the diagnosis brings none, and what to do next."""

    badge: str
    headline: str
    advice: str


VERDICTS = {
    "no_gap": Verdict(
        "No gap",
        "The simulator reproduces the logs as well as their noise allows.",
        "Train on the simulator as it is. Motions unlike the logged ones are not covered: log those too.",
    ),
    "parameters": Verdict(
        "Parameters only",
        "Recalibrating what the simulator already has closes the gap, as far as these logs tell.",
        "Take over the recalibrated parameters listed below: pass effects=effects.yaml, which holds them, to main, "
        "train or play. These logs ask for no effect.",
    ),
    "noise": Verdict(
        "Noise larger than estimated",
        "Nothing predicts what remains, and it has the covariance of noise of the sensors.",
        "Take over the recalibrated parameters listed below. State what the sensors are worth (sigma: in the logs' "
        "metadata), or repair them; no effect needs to be added.",
    ),
    "effects": Verdict(
        "Missing effects found",
        "The simulator leaves out effects that these logs identify.",
        "Pass effects=effects.yaml to main, train or play, or load model_with_effects.xml in plain MuJoCo.",
    ),
    "ambiguous": Verdict(
        "Ambiguous",
        "Several explanations fit these logs equally well.",
        "Run the next experiment below: it separates the rivals. Until then, randomise over all of them.",
    ),
    "unexplained": Verdict(
        "Unexplained",
        "Part of the gap is reproducible, but no effect in the library explains it.",
        "Look at where the remaining force acts, below, and give the cause as an effect of your own "
        "(--effects file.py:Name).",
    ),
    "insufficient_data": Verdict(
        "Too little data",
        "These logs cannot tell.",
        "Repair or extend the logs as the warnings below say, and diagnose again.",
    ),
}


PARTLY = Verdict(
    "Partly explained",
    "The named effects leave more of the gap than is tolerated.",
    "Pass effects=effects.yaml to main, train or play for what was found. For the rest, look at where the remaining "
    "force acts, below, and give the cause as an effect of your own (--effects file.py:Name); or allow more with "
    "--tolerance.",
)


REMAINDER = Verdict(
    "Effects and a remainder",
    "The named effects explain most of the gap; more than is tolerated remains.",
    "Pass effects=effects.yaml to main, train or play. Their laws are not quite those of the real system: allow what "
    "remains with --tolerance, or look at where the remaining force acts, below, and give a law of your own "
    "(--effects file.py:Name).",
)


def verdict_of(d: Diagnosis) -> Verdict:
    """The verdict's words; what remains beside named effects has its own."""
    if d.verdict == "effects" and d.gap.beyond:
        return REMAINDER
    return PARTLY if d.verdict == "unexplained" and d.effects else VERDICTS[d.verdict]


def stages_told(d: Diagnosis) -> dict[str, str]:
    """The stages that are there to be told: none with effects where there are none, no floor where nothing repeats."""
    left_out = {"with_effects": not d.effects, "reducible_floor": not repeated(d)}
    return {s: words for s, words in STAGES.items() if not left_out.get(s)}


def repeated(d: Diagnosis) -> bool:
    """Whether the reducible floor is known from runs that were repeated."""
    return any(h.get("floor") == "repeats" for h in d.gap.horizons)


def length(value: Any, in_unit: str) -> str:
    """An error in degrees, millimetres or metres, see `quantities.extent`."""
    return typeset(quantities.extent(value, in_unit)) if finite(value) else MISSING


def closure(share: Any) -> str:
    """A share of the gap closed; a model that widens it closes none."""
    return "none, it is worse" if finite(share) and share < -0.0005 else percent(share)


def known_span(span: Any) -> tuple[float, float] | None:
    """Both ends of an interval, or None where one is not known."""
    return (span[0], span[1]) if span is not None and all(map(finite, span)) else None


def spanned(span: Any) -> str:
    """The ends of an interval of a gap in brackets; of one that says nothing, that it is wide."""
    span = known_span(span)
    if span is None:
        return ""
    wide = span[1] > WIDE * max(span[0], 0.0)
    return f" (interval wider than a factor of {WIDE})" if wide else f" ({number(span[0])} – {number(span[1])})"


def number(value: Any, digits: int = 3) -> str:
    """`quantities.number` with a minus sign in place of a hyphen."""
    return typeset(quantities.number(value, digits))


def percent(share: Any, sign: bool = False) -> str:
    """`quantities.percent` with a minus sign in place of a hyphen."""
    return typeset(quantities.percent(share, sign))


def estimate(mean: Any, sd: Any = math.nan, in_unit: str = "") -> str:
    """`0.0312 ± 0.0021 N m`, see `quantities.estimate`; seconds below 0.5 as ms."""
    if in_unit == "s" and finite(mean) and abs(mean) < 0.5:
        mean, sd, in_unit = 1e3 * mean, 1e3 * sd if finite(sd) else sd, "ms"
    tail = f" {unit(in_unit)}" if in_unit else ""
    return typeset(quantities.estimate(mean, sd)) + tail


def effect_noun(name: str) -> str:
    return words(name).noun


def effect_title(name: str, where: str) -> str:
    """`Coulomb friction at joint 'elbow'`."""
    title = words(name).at(where, quoted=True)
    return title[:1].upper() + title[1:]


def label_title(label: str, short: bool = False) -> str:
    """`coulomb_friction@elbow` -> `Coulomb friction at joint 'elbow'`, or in short `Coulomb friction · elbow`."""
    name, _, where = str(label).partition("@")
    if short and where:
        title = effect_noun(name)
        return f"{title[:1].upper()}{title[1:]} · {where}"
    return effect_title(name, where) if where or words(name).kind else str(label)


def candidate_title(candidate: Mapping[str, Any]) -> str:
    """`Coulomb friction · elbow, wrist + Command delay · motor`: each law once, with its places."""
    places: dict[str, list[str]] = {}
    for label in candidate.get("effects") or []:
        law, _, place = label_title(label, short=True).partition(" · ")
        places.setdefault(law, []).append(place)
    titles = [" · ".join(filter(None, (law, ", ".join(filter(None, at))))) for law, at in places.items()]
    return " + ".join(titles) or str(candidate.get("label") or "no effect")


def not_fitted(d: Diagnosis, most: int | None = None) -> list[str]:
    """`no gain at first order: Payload · link, ...` for each reason; at most so many of each."""
    lines = []
    for reason, labels in d.not_fitted.items():
        more = len(labels) - len(labels[:most])
        named = ", ".join(label_title(label, short=True) for label in labels[:most])
        lines.append(f"{reason}: {named}" + (f" and {more} more" if more else ""))
    return lines


def quantity(name: str, value: Estimate) -> tuple[str, str]:
    """A parameter's name and value for people; reciprocals turned over (`inverse_limit` 0.5 1/(N m) -> limit 2 N m)."""
    if name in RECIPROCALS and finite(value.mean) and value.mean > 0:
        sd = value.sd / value.mean**2 if finite(value.sd) else value.sd  # d(1/x) = dx / x^2
        turned = {"at least": "at most", "at most": "at least"}.get(value.bound, value.bound)
        return RECIPROCALS[name], _bounded(estimate(1 / value.mean, sd, _turned(value.unit)), turned)
    return name.replace("_", " "), _bounded(estimate(value.mean, value.sd, value.unit), value.bound)


def _bounded(text: str, bound: str) -> str:
    """A value that ends at a bound (`Estimate.bound`)."""
    if bound in ("at least", "at most"):
        return f"{bound} {text}"
    return text + {"off": " (off)", "end": " (end of its range)"}.get(bound, "")


def _turned(text: str) -> str:
    over, _, under = text.partition("/")
    under = under.removeprefix("(").removesuffix(")")
    return under if over in ("1", "") else f"{under}/{over}"


def effect_line(effect: FoundEffect) -> str:
    """`Coulomb friction at joint 'elbow': 0.031 ± 0.002 N m`; several parameters by name."""
    found = [quantity(k, v) for k, v in effect.parameters.items()]
    values = [v if len(found) == 1 else f"{k} {v}" for k, v in found]
    return effect_title(effect.name, effect.where) + (": " + ", ".join(values) if values else "")


def accuracy(d: Diagnosis) -> str:
    """`mass 4.9 % (90 %: 2.1 % – 12 %), damping ...`: inferred accuracies of the model's numbers; "" if stated."""
    each = [f"{k} {percent(own['median'])} (90 %: {between(own['low'], own['high'])})" for k, own in d.accuracy.items()]
    return ", ".join(each)


def headline(diagnosis: Diagnosis) -> str:
    return diagnosis.sentences[0] if diagnosis.sentences else verdict_of(diagnosis).headline


def gap_closed(stages: Mapping[str, Any]) -> float:
    """Share of the reducible squared gap closed between delivery and the effects; NaN where unknown."""
    known = [float(v) for k in ("nominal", "with_effects", "reducible_floor") if finite(v := stages.get(k))]
    return of_rms(*known).closed if len(known) == 3 else math.nan


def stages_of(d: Diagnosis) -> dict[str, float]:
    return {s: getattr(d.gap, s) for s in STAGES}


def between(low: Any, high: Any) -> str:
    """`96 % – 99.9 %`: the ends of an interval of shares; with more digits where they would look the same."""
    if not (finite(low) and finite(high)):
        return ""
    ends = [percent(low), percent(high)]
    if ends[0] == ends[1] and low < high:
        places = 1 - quantities.power(100 * (high - low))
        ends = [f"{quantities.fixed(100 * end, places)} %" for end in (low, high)]
    return " – ".join(ends)
