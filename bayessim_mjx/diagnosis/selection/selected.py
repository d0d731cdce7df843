"""The whole selection: the model that the logs call for, its rivals, its parts and their probabilities, frozen."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bayessim_mjx.diagnosis.fitting.candidates import Candidate
from bayessim_mjx.diagnosis.fitting.fitter import Fit, Fitter
from bayessim_mjx.diagnosis.selection.models import Model
from bayessim_mjx.diagnosis.selection.pool import Pool
from bayessim_mjx.diagnosis.selection.screen import Screened
from bayessim_mjx.diagnosis.selection.sets import Estimated, Key, Weighed
from bayessim_mjx.diagnosis.selection.tried import Settings, Tried

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Size:
    """How large an effect is: the parameter that lies most standard deviations from neutral, and by how much.

    Attributes:
        quantity: the parameter's name; mean, sd: of its distance from neutral, in its unit.
    """

    quantity: str
    mean: float
    sd: float
    unit: str


def size_of(effect: Candidate, values: Array, sd: Array) -> Size:
    """How large an effect with these numbers `[k]` and standard deviations `[k]` is; shapes are no sizes."""
    each = zip(effect.coordinates, effect.shapes, values, sd, strict=True)
    sizes = [
        Size(c.name.rsplit(".", 1)[1], abs(float(v - c.neutral)), float(s), c.unit)
        for c, shape, v, s in each
        if not shape
    ]
    return max(sizes, key=lambda size: size.mean / max(size.sd, 1e-12))


@dataclass(frozen=True, eq=False)
class Rival:
    """Another explanation that these logs cannot tell from (a part of) the answer.

    Attributes:
        effects: those that the answer does not have; model: with the answer's other ones.
        closure: share of the gap that the model closes; why: in words.
        contains: whether it is the effect and more: no other explanation.
        size: of its effect, where it is a single one.
    """

    effects: tuple[Candidate, ...]
    model: Model
    closure: float
    why: str
    contains: bool = False
    size: Size | None = None

    def to_dict(self) -> dict[str, Any]:
        return {"effects": [c.label for c in self.effects], "gap_closed": self.closure, "why": self.why}


@dataclass(frozen=True, eq=False)
class Selection(Tried):
    """What the selection came to.

    Attributes:
        answer: the model that is named (`base` where nothing is).
        rivals: {label of one of its effects: what may stand in its place}.
        subsets: {labels: the model with these of its effects}, every one refitted; {} of one effect or of too many.
        promised: share of the base model's gap that its effects promised to close before any was fitted, {label: part}.
        chosen: {operating condition: effects that are named without it}.
        elsewhere: share of the gap closed on conditions that the choice was made without; NaN of one condition.
        hidden: labels of effects that would not show beside those of the answer (`selection.hidden`).
        stand_ins: {known parameter: labels of effects that it may stand for} (`selection.stand_ins`).
        weighed: probabilities of the sets that were fitted; estimated: posterior of the answer's numbers.
    """

    fitter: Fitter
    candidates: tuple[Candidate, ...]
    settings: Settings
    nominal: Fit
    base: Model
    models: Mapping[Key, Model]
    screened: tuple[Screened, ...]
    cut_short: frozenset[str]
    skipped: Mapping[str, int]
    answer: Model
    rivals: Mapping[str, tuple[Rival, ...]]
    subsets: Mapping[Key, Model]
    promised: tuple[float, Mapping[str, float]]
    chosen: Mapping[int, Key]
    elsewhere: float
    hidden: tuple[str, ...]
    stand_ins: Mapping[str, tuple[str, ...]]
    weighed: Weighed
    estimated: Estimated

    @property
    def ambiguous(self) -> bool:
        """Whether something else than what contains an effect as a special case would do as well."""
        return any(not r.contains for rivals in self.rivals.values() for r in rivals)


def selection_of(pool: Pool, answer: Model, **concluded: Any) -> Selection:
    """What a pool holds, its answer, and what was concluded of it (see `Selection`)."""
    return Selection(
        fitter=pool.fitter,
        candidates=tuple(pool.candidates),
        settings=pool.settings,
        nominal=pool.nominal,
        base=pool.models[frozenset()],
        models=MappingProxyType(dict(pool.models)),
        screened=tuple(pool.screened),
        cut_short=frozenset(pool.cut_short),
        skipped=MappingProxyType(dict(pool.skipped)),
        answer=answer,
        **concluded,
    )
