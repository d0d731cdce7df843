"""The next experiment in words: its motion, what it separates or measures better, and what else would help."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

from bayessim_mjx.effects.support.words import words
from bayessim_mjx.quantities import percent


def known_payload(mass: float, place: str) -> tuple[str, str]:
    """(addition to an experiment's name, instruction for a person)."""
    return (
        f"with a known payload of {mass:g} kg on {place}",
        f"a person: fix a known mass of {mass:g} kg at the centre of {place}",
    )


def other_mount(way: str) -> tuple[str, str]:
    """Return the same of a base that is mounted another way."""
    return f"base {way}", f"a person: mount the base {way}"


def separating(effects: Iterable[str]) -> str:
    """Other experiments that separate effects, in their own words."""
    known = [f"{e.replace('_', ' ')}: {how}" for e in dict.fromkeys(effects) if (how := words(e).separates)]
    return "; ".join(known) or "a known payload, two mount orientations, or a measured effort"


def nats(evidence: float) -> str:
    """Ten or more as a whole number."""
    return f"{evidence:.0f}" if evidence >= 10 else f"{evidence:.1f}"


def nothing_safe(help: str) -> str:
    """Of a menu without a safe experiment; `help`: of `separating`."""
    return f"no experiment of the menu stays within the limits; these would help: {help}"


def run_experiment(name: str, seconds: float) -> str:
    """`run a chirp on hinge for 10 s`."""
    article = "a " if name.startswith(("slow triangle", "staircase", "chirp", "multisine")) else ""
    return f"run {article}{name} for {seconds:.0f} s"


def sharpens(action: str, parameter: str, before: float, after: float) -> str:
    """Return the gain in accuracy of a parameter, where no rival is left.

    As a ratio: both are of noise alone, and so smaller than the standard deviation that the diagnosis reports.
    """
    return f"{action}: it should divide the standard deviation of {parameter} by {before / after:.2g}"


def sharpens_little(best: str, parameter: str, before: float, after: float) -> str:
    """Say that no experiment helps; best: its name, with the parameter that it measures best."""
    left = percent(after / before)
    return (
        f"no experiment of the menu adds much; the best, {best}, leaves {left} of the standard deviation of {parameter}"
    )


def separates_nobody(labels: Sequence[str], best: str, evidence: float, help: str) -> str:
    """Why an experiment does not help, of models' titles, its name and the nats that it would give."""
    most = f"the best, {best}, is expected to give {nats(evidence)} nats"
    return f"no safe excitation separates {_apart(labels)} ({most}); these would: {help}"


def tells_apart(action: str, labels: Sequence[str], evidence: float, contested: bool, decides: float) -> str:
    """Name the models that an experiment separates; contested: whether the logs left it open; decides: nats that do."""
    times = math.ceil(decides / max(evidence, 1e-9))
    again = f"; repeat it {times} times for a decision" if 1 < times <= decides else ""
    whom = f"separates {_apart(labels)}" if contested else f"confirms {_apart(labels, 'against')}"
    return f"{action}: {whom}, expected evidence {nats(evidence)} nats{again}"


def _apart(labels: Sequence[str], word: str = "from") -> str:
    return f"{labels[0]} {word} {', or '.join(labels[1:])}"  # labels may hold an "and"
