"""Numbers of a diagnosis as the page and the terminal print them, and the typesetting of sentences for the page."""

import math
import re
from collections.abc import Mapping
from typing import Any

from bayessim_mjx import effects as library
from bayessim_mjx import quantities
from bayessim_mjx.diagnosis.phrases.effects import label_title, measured
from bayessim_mjx.diagnosis.phrases.effects import quantity as _quantity
from bayessim_mjx.diagnosis.result import Diagnosis, Estimate
from bayessim_mjx.diagnosis.statistics import of_rms
from bayessim_mjx.effects.support.words import spelt
from bayessim_mjx.quantities import finite, typeset

MISSING = quantities.MISSING  # where there is no number
TINY = 1e-6  # in SI units: smaller values in the table of candidates are zeros of a fit; no source: a matter of style
WIDE = 1000  # ratio of an interval's ends, from which on it is not printed in numbers; no source: a matter of style
# that stay with their number
UNITS = r"(?<=\d) ± (?=[\d−])|(?<=\d) (?:N m|noise sd|N|rad|deg|mm|ms|m|s|kg|%)(?![A-Za-z])|(?<=N m) s(?![A-Za-z])"
STAGES = {
    "nominal": "as delivered",
    "calibrated": "recalibrated",
    "with_effects": "with effects",
    "reducible_floor": "reducible floor",
    "noise_floor": "noise floor",
}


def signs(text: Any) -> str:
    """Return a sentence with `±`, minus signs and superscripts in place of ASCII."""
    text = re.sub(r"\^(-?\d+)", lambda power: power[1].translate(quantities.SUPERSCRIPT), str(text))
    return re.sub(r"(?<![\w.-])-(?=\d)", "−", text.replace(" +- ", " ± "))


def page(text: Any) -> str:
    """Return a sentence as it is printed on a page: with `signs`, and no line break between a number and its unit."""
    return re.sub(UNITS, lambda tied: tied[0].replace(" ", "\N{NO-BREAK SPACE}"), signs(text))


def stages_told(d: Diagnosis) -> dict[str, str]:
    """Return the stages that exist: none with effects where there are none, no floor where nothing repeats."""
    left_out = {"with_effects": not d.effects, "reducible_floor": not repeated(d)}
    return {s: words for s, words in STAGES.items() if not left_out.get(s)}


def repeated(d: Diagnosis) -> bool:
    """Whether the reducible floor is known from runs that were repeated."""
    return any(h.get("floor") == "repeats" for h in d.gap.horizons)


def length(value: Any, in_unit: str) -> str:
    """Return an error in degrees, millimetres or metres, see `quantities.extent`."""
    return typeset(quantities.extent(value, in_unit)) if finite(value) else MISSING


def closure(share: Any) -> str:
    """Return a share of the gap closed; a model that widens it closes none."""
    return "none, it is worse" if finite(share) and share < -0.0005 else percent(share)


def known_span(span: Any) -> tuple[float, float] | None:
    """Both ends of an interval, or None where one is not known."""
    return (span[0], span[1]) if span is not None and all(map(finite, span)) else None


def wide(span: tuple[float, float]) -> bool:
    """Whether an interval is too wide for numbers."""
    return span[1] > WIDE * max(span[0], 0.0)


def spanned(span: Any) -> str:
    """Return the ends of an interval of a gap in brackets; one without information is called wide."""
    span = known_span(span)
    if span is None:
        return ""
    return f" (interval wider than a factor of {WIDE})" if wide(span) else f" ({number(span[0])} – {number(span[1])})"


def number(value: Any, digits: int = 3) -> str:
    """`quantities.number` with a minus sign in place of a hyphen."""
    return typeset(quantities.number(value, digits))


def percent(share: Any, sign: bool = False) -> str:
    """`quantities.percent` with a minus sign in place of a hyphen."""
    return typeset(quantities.percent(share, sign))


def estimate(mean: Any, sd: Any = math.nan, in_unit: str = "") -> str:
    """`0.0312 ± 0.0021 N m`, see `phrases.effects.measured`."""
    return signs(measured(mean, sd, in_unit))


def quantity(name: str, value: Estimate, effect: str = "") -> tuple[str, str]:
    """Return a parameter's name and value, see `phrases.effects.quantity`."""
    title, text = _quantity(name, value, effect)
    return title, signs(text)


def own_number(name: str, value: Any, hinged: bool) -> str:
    """Write a candidate's `<where>.<effect>.<parameter>`, with its unit where all joints are hinges."""
    law, _, key = name.rpartition(".")
    law = law.rpartition(".")[2]
    if isinstance(value, Mapping):
        return f"{spelt(key, law)} {estimate(value.get('mean'), value.get('sd'), value.get('unit', ''))}"
    if not finite(value) or abs(value) < TINY:
        return f"{spelt(key, law)} {number(0 if finite(value) else value)}"
    kind = library.known(law) if hinged else None  # a slide's units are others
    units = {q.name: q.unit for q in kind.quantities} if kind else {}
    return " ".join(quantity(key, Estimate(float(value), math.nan, units.get(key, "")), law))


def not_fitted(d: Diagnosis, most: int | None = None) -> list[str]:
    """`no gain at first order: Payload (link, tool), ...` for each reason; at most so many effects of each."""
    lines = []
    for reason, labels in d.not_fitted.items():
        laws: dict[str, list[str]] = {}
        for law, _, place in (label_title(label, short=True).partition(" · ") for label in labels):
            laws.setdefault(law, []).append(place)
        each = [f"{law} ({', '.join(at)})" if any(at) else law for law, at in laws.items()]
        lines.append(f"{reason}: {quantities.listed(each, most=most)}")
    return lines


def accuracy(d: Diagnosis) -> str:
    """`mass 4.9 % (90 %: 2.1 % – 12 %), damping ...`: inferred accuracies of the model's numbers; "" if stated."""
    each = [f"{k} {percent(own['median'])} (90 %: {between(own['low'], own['high'])})" for k, own in d.accuracy.items()]
    return ", ".join(each)


def gap_closed(stages: Mapping[str, Any]) -> float:
    """Share of the reducible squared gap closed between delivery and the effects; NaN where unknown."""
    known = [float(v) for k in ("nominal", "with_effects", "reducible_floor") if finite(v := stages.get(k))]
    return of_rms(*known).closed if len(known) == 3 else math.nan


def stages_of(d: Diagnosis) -> dict[str, float]:
    return {s: getattr(d.gap, s) for s in STAGES}


def between(low: Any, high: Any) -> str:
    """`96 % – 99.9 %`: the ends of an interval of shares; with more digits where they would look the same.

    One as wide as all shares from 0 to 1, as of two conditions, determines nothing.
    """
    if not (finite(low) and finite(high)):
        return ""
    if high - low >= 1:
        return "not determined"
    ends = [percent(low), percent(high)]
    if ends[0] == ends[1] and low < high:
        places = min(1 - quantities.power(100 * (high - low)), 2)
        ends = [f"{quantities.fixed(100 * end, places)} %" for end in (low, high)]
    return " – ".join(dict.fromkeys(ends))  # one number where two decimals do not separate them
