"""Which candidates may be in one model, and which are special cases of others."""

from __future__ import annotations

import functools

from bayessim_mjx.diagnosis.fitting.candidates import Candidate
from bayessim_mjx.effects import load, names


def compatible(a: Candidate, b: Candidate) -> bool:
    """Not the same numbers twice (an effect at one joint and tied over all)."""
    return not {i for c in a.coordinates for i in c.index} & {i for c in b.coordinates for i in c.index}


def beside(a: Candidate, b: Candidate) -> bool:
    """Whether both may be in one model: not the same numbers twice, nor a law beside its special case."""
    within = a.where == b.where and (a.effect in special_cases(b) or b.effect in special_cases(a))
    return a.label != b.label and compatible(a, b) and not within


def special_case(one: Candidate, of: Candidate) -> bool:
    """Whether it is a special case of a law at its place, or of a law that is tied over all places at one of them."""
    at_one = of.where == "all" != one.where and one.kind == of.kind
    contained = one.effect in special_cases(of)
    return contained and (at_one or one.where == of.where) or at_one and one.effect == of.effect


def related(one: Candidate, other: Candidate) -> bool:
    """Whether the one may stand for the other: a special case, a law that contains it, or other inertia of its body."""
    here = one.where == other.where and one.effect != other.effect
    return special_case(one, other) or (here and special_case(other, one)) or inertia(one, other)


def inertia(one: Candidate, other: Candidate) -> bool:
    """Whether both change the inertia of the same body."""
    here = one.kind == other.kind == "body" and one.where == other.where and one.effect != other.effect
    return here and _inertial(one.effect) and _inertial(other.effect)


def special_cases(effect: Candidate) -> tuple[str, ...]:
    """Names of the effects that it contains, from its class."""
    return _contained(effect.effect)


@functools.cache  # thousands of pairs are compared, and all installed packages are looked through for a name
def _contained(effect: str) -> tuple[str, ...]:
    return tuple(getattr(load(effect), "contains", ())) if effect in names() else ()


@functools.cache
def _inertial(effect: str) -> bool:
    return effect in names() and bool(load(effect).inertial)
