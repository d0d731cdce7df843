"""How facts are put into words: effects, places in the state, missing forces, bounds, rivals, experiments."""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

from bayessim_mjx.effects.support.words import words
from bayessim_mjx.quantities import listed, percent

AXES = {
    "position": "position", "speed": "speed", "load": "gravity load", "effort": "effort", "time": "time in the log",
    "speed size": "speed", "load size": "gravity load (size)", "effort size": "effort (size)",
}  # fmt: skip
WITHIN_NOISE = "what this model leaves lies within the measurement noise"
CONTAINS = "contains it as a special case and explains no more"
NO_GAIN = "no gain at first order"  # why effects were not fitted
LESS_PROMISING = "less promising than those that were fitted"
NO_TIME_LEFT = "no time left"
NOTHING_LEFT = "the known parameters leave too little to explain"
NOT_SCREENED = "no time to look at them"
OPPOSITES = ("against/with", "more/less")  # of which a number's sign chooses one


@dataclass(frozen=True)
class Phrases:
    """How a signature of the missing force is told.

    Attributes:
        head: what its sentence begins with; terms: {name of a number: words after it}, for those that are told.
    """

    head: str
    terms: Mapping[str, str]


SIGNATURES = {
    "odd and even in speed": Phrases(
        "of the missing force",
        {"constant": "against/with the motion at any speed", "linear": "against/with the motion, linear in speed",
         "quadratic": "against/with the motion, quadratic in speed", "offset": "always the same way",
         "even": "with speed but always the same way"},
    ),
    "load": Phrases("the force against the motion changes by", {"load": "of gravity load"}),
    "time": Phrases(
        "in the course of a log the force changes by",
        {"friction": "against the motion", "drift": "always the same way"},
    ),
    "time since reversal": Phrases(
        "within {recent:g} s after reversals the force against the motion is", {"recent": "more/less"}
    ),
    "lag": Phrases(
        "the measured motion lags behind the simulated one by",
        {"constant": "at any speed", "lag": "times the speed"},
    ),
}  # fmt: skip


def region(limits: Iterable[tuple[str, bool, float]], units: Mapping[str, str]) -> str:
    """`speed below 0.2 rad/s, moving forward`, of (axis, above, limit); nested limits of one axis: the tighter one."""
    kept: dict[str, dict[bool, float]] = {}
    for axis, above, limit in limits:
        own = kept.setdefault(axis, {})
        own[above] = limit if above not in own else (max if above else min)(own[above], limit)
    return ", ".join(_side(axis, own, units[axis]) for axis, own in kept.items()) or "everywhere"


def _side(axis: str, own: Mapping[bool, float], unit: str) -> str:
    if axis == "direction":
        return "moving forward" if True in own else "moving backward"
    if axis == "time since reversal":
        ends = [f"{'later than' if above else 'within'} {limit:.2g} s" for above, limit in own.items()]
        return f"{' and '.join(ends)} after a reversal"
    if len(own) == 2:
        return f"{AXES[axis]} between {own[True]:.2g} and {own[False]:.2g} {unit}".rstrip()
    ((above, limit),) = own.items()
    return f"{AXES[axis]} {'above' if above else 'below'} {limit:.2g} {unit}".rstrip()


def missing_force(mean: float, unit: str, along: bool) -> str:
    """`0.3 N m against the motion`; with a sign where it does not go along with the motion."""
    return f"{abs(mean):.2g} {unit} {'against' if mean < 0 else 'with'} the motion" if along else f"{mean:+.2g} {unit}"


def placeless_force(joint: str, size: float, unit: str) -> str:
    """Of a missing force that no region of the state tells."""
    return f"{joint}: a missing force of {size:.2g} {unit} rms without a simple place in the state"


def bracketed(value: float, low: float, high: float, unit: str) -> str:
    """`0.3 [0.2, 0.4] N m`."""
    return f"{value:.2g} [{low:.2g}, {high:.2g}] {unit}"


def signed(value: float, low: float, high: float, unit: str, phrase: str) -> str:
    """A number with its interval and phrase; its sign in words where the phrase has a place for it."""
    for pair in OPPOSITES:
        if pair in phrase:
            positive = value > 0
            shown = (value, low, high) if positive else (-value, -high, -low)
            return f"{bracketed(*shown, unit)} {phrase.replace(pair, pair.split('/')[0 if positive else 1])}"
    return f"{bracketed(value, low, high, unit)} {phrase}"


def at_bound(kind: str, at: float, unit: str, physical: bool) -> str:
    """Of a parameter that ends at a bound, see `bounds.Bound`; a clause, after the parameter's name."""
    if kind == "off":
        return f"is {at:.3g}, where it has no part in the effect"
    value = f"{at:.3g} {unit}" if unit else f"{at:.3g}"
    if kind == "end":
        further = f"ends at its bound {value}; a wider range explains no more"
        return f"ends at {value}, where physics ends" if physical else further
    which = "largest" if kind == "at least" else "smallest"
    return f"ends at {value}, the {which} value tried: {kind} this, or another law is behind it"


def close_by(nats: float, behind: float) -> str:
    """Why a model is a rival: how little evidence and closure part it from what is named."""
    return f"held-out evidence differs by {nats:.1f} nats, {percent(max(behind, 0.0))} of the gap"


def stuck(value: float) -> str:
    """Of a known parameter at its bound."""
    return f"sits at its bound {value:.4g}: it stands in for something else, or its range is too narrow"


def far_from_data_sheet(value: float, away: float) -> str:
    """Of a known parameter whose accuracy was stated."""
    return f"is {value:.4g}, {away:.1f} sd from the data sheet"


def less_accurate(found: Mapping[str, tuple[float, float, float]]) -> str:
    """Of kinds of known parameters, {kind: (median, low, high)}, whose accuracy nobody stated."""
    each = [f"{kind} about {m:.0%} (90 %: {low:.0%} to {high:.0%})" for kind, (m, low, high) in found.items()]
    return (
        f"the model's numbers seem less accurate than usual: {', '.join(each)}; the intervals allow for it; "
        "--accuracy fixes it"
    )


def moves(spread: float, groups: int, blocks: bool = False) -> str:
    """Of a known parameter that differs between operating conditions; said in 3 % of checks with nothing hidden."""
    where = "parts of the log" if blocks else "operating conditions"
    return f"moves between {where} (sd {spread:.3g} over {groups}): something may be missing"


def model_title(effects: Sequence[tuple[str, str]]) -> str:
    """`load friction at elbow and command delay at elbow_motor`, of (effect, where)."""
    return listed([words(name).at(where) for name, where in effects]) or "the known parameters alone"


def known_payload(mass: float, place: str) -> tuple[str, str]:
    """(what is added to an experiment's name, what a person does)."""
    return (
        f"with a known payload of {mass:g} kg on {place}",
        f"a person: fix a known mass of {mass:g} kg at the centre of {place}",
    )


def other_mount(way: str) -> tuple[str, str]:
    """The same of a base that is mounted another way."""
    return f"base {way}", f"a person: mount the base {way}"


def separating(effects: Iterable[str]) -> str:
    """What else would tell effects apart, in their own words."""
    known = [f"{e.replace('_', ' ')}: {how}" for e in dict.fromkeys(effects) if (how := words(e).separates)]
    return "; ".join(known) or "a known payload, two mount orientations, or a measured effort"


def nats(evidence: float) -> str:
    """Ten or more as a whole number."""
    return f"{evidence:.0f}" if evidence >= 10 else f"{evidence:.1f}"


def nothing_safe(help: str) -> str:
    """Why no experiment is proposed: none of the menu can be run; `help`: of `separating`."""
    return f"no experiment of the menu stays within the limits; what would help: {help}"


def run_experiment(name: str, seconds: float) -> str:
    """`run a chirp on hinge for 10 s`."""
    article = "a " if name.startswith(("slow triangle", "staircase", "chirp", "multisine")) else ""
    return f"run {article}{name} for {seconds:.0f} s"


def sharpens(action: str, parameter: str, before: float, after: float, unit: str) -> str:
    """What an experiment does to the standard deviation of a parameter, where no rival is left."""
    return f"{action}: sharpens {parameter}, standard deviation from {before:.2g} to {after:.2g} {unit}".rstrip()


def sharpens_little(best: str, parameter: str, before: float, after: float, unit: str) -> str:
    """Why an experiment does not help, of its name and what it would do to the standard deviation of a parameter."""
    return f"none would tell much more; the best, {sharpens(best, parameter, before, after, unit)}"


def separates_nobody(labels: Sequence[str], best: str, evidence: float, help: str) -> str:
    """Why an experiment does not help, of models' titles, its name and the nats that it would give."""
    most = f"the best, {best}, is expected to give {nats(evidence)} nats"
    return f"no safe excitation separates {_apart(labels)} ({most}); what would: {help}"


def tells_apart(action: str, labels: Sequence[str], evidence: float, contested: bool) -> str:
    """What an experiment separates; contested: whether the logs left it open."""
    weak = 10.0 / max(evidence, 1e-9)
    again = f"; repeat it {math.ceil(weak)} times for a decision" if 1.3 < weak <= 10 else ""
    whom = f"separates {_apart(labels)}" if contested else f"makes sure of {_apart(labels, 'against')}"
    return f"{action}: {whom}, expected evidence {nats(evidence)} nats{again}"


def _apart(labels: Sequence[str], word: str = "from") -> str:
    return f"{labels[0]} {word} {', '.join(labels[1:-1]) + ' and ' if len(labels) > 2 else ''}{labels[-1]}"


def missing(name: str, where: str) -> str:
    """`a command delay at torque`, after "the simulator lacks"."""
    own = words(name)
    return own.at(where, own.lacks)


def titled(name: str, where: str) -> str:
    """`extra payload at tool`, on its own."""
    return words(name).at(where)


def by_law(effects: Iterable[Sequence[str]]) -> list[str]:
    """What is missing, a phrase for each law: `Coulomb friction at shoulder and elbow`.

    Args:
        effects: (name, place) of each.
    """
    places: dict[str, list[str]] = {}
    for name, where in effects:
        places.setdefault(name, []).append(where)
    own = {name: [w for w in where if w not in ("", "world", "all")] for name, where in places.items()}
    some = {name: [listed(at)] if len(at) > 1 else at for name, at in own.items()}
    tied = {name: [w for w in where if w in ("", "world", "all")] for name, where in places.items()}
    return [missing(name, where) for name in places for where in [*some[name], *tied[name]]]
