"""Candidates as a decision sees them: which are special cases of others, and which may be in one model."""

from __future__ import annotations

import functools

from bayessim_mjx.diagnosis.fitting.candidates import Candidate
from bayessim_mjx.diagnosis.selection.table import SPREADS, Law
from bayessim_mjx.effects import load, names


def compatible(a: Candidate, b: Candidate) -> bool:
    """Not the same numbers twice (an effect at one joint and tied over all)."""
    return not {i for c in a.coordinates for i in c.index} & {i for c in b.coordinates for i in c.index}


def beside(a: Candidate, b: Candidate) -> bool:
    """Whether both may be in one model (`Law.beside`)."""
    return law_of(a).beside(law_of(b))


def law_of(candidate: Candidate) -> Law:
    """What a decision knows of a candidate."""
    index = frozenset(i for c in candidate.coordinates for i in c.index)
    names = candidate.label, candidate.effect, candidate.where
    spread = candidate.kind in SPREADS or _of_each(candidate.effect)
    return Law(*names, len(candidate.coordinates), index, special_cases(candidate), candidate.kind, spread)


def special_cases(effect: Candidate) -> tuple[str, ...]:
    """Names of the effects that it contains, from its class."""
    return _contained(effect.effect)


@functools.cache  # thousands of pairs are compared, and all installed packages are looked through for a name
def _contained(effect: str) -> tuple[str, ...]:
    return tuple(getattr(load(effect), "contains", ())) if effect in names() else ()


@functools.cache
def _of_each(effect: str) -> bool:
    """Whether a robot has it at every body (`Effect.each`)."""
    return effect in names() and load(effect).each
