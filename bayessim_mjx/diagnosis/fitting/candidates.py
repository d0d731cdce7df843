"""What may be wrong: every effect at every place, and tied over all places, as coordinates of one vector theta."""

from __future__ import annotations

import itertools
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace

import mujoco
import numpy as np
from numpy.typing import NDArray

from bayessim_mjx import effects as library
from bayessim_mjx.diagnosis.data_sheet import WORST
from bayessim_mjx.diagnosis.fitting.quadratic import RULES
from bayessim_mjx.diagnosis.fitting.scales import Scales, ranges
from bayessim_mjx.effects.effect import Block, Effect, Quantity, in_order
from bayessim_mjx.effects.support.quantity import STATED
from bayessim_mjx.effects.support.site import element_names, places
from bayessim_mjx.errors import UserError
from bayessim_mjx.parameters import Parameter, ParameterSpace
from bayessim_mjx.physics import Physics

Array = NDArray[np.float64]
STEP = 0.005  # of the range: first finite differences, before `Fit.steps` knows the columns; not counted


@dataclass(frozen=True)
class Coordinate:
    """One number to be fitted: the same value at one or several entries of theta.

    Attributes:
        name: of the (first) parameter; index: its entries in theta.
        neutral, low, high: unit as the parameter's.
        precision: of a Gaussian prior around neutral, 1/unit^2 (0: flat between the bounds).
        stated: the prior is what a data sheet states. It then weighs as much as the misfit says that the data know:
            while an effect is missing, no parameter takes its place because the noise alone is small.
        kind: of a data sheet's number (mass, damping ...) whose accuracy nobody stated: it is common to all of that
            kind, and inferred from the logs (`Fit.trust`, `evidence.parameters`). "": it is not inferred.
        unit: for people.
    """

    name: str
    index: tuple[int, ...]
    neutral: float
    low: float
    high: float
    precision: float = 0.0
    unit: str = ""
    stated: bool = False
    kind: str = ""

    @property
    def step(self) -> float:
        span = self.high - self.low
        return STEP * (min(span, WORST * abs(self.neutral)) if self.stated and self.neutral else span)


@dataclass(frozen=True)
class Candidate:
    """One effect at one place (or tied over all), with the coordinates that describe it. Equal whatever its ranges are.

    Attributes:
        effect, where: names; `where` = "all" if tied over several places.
        kind: actuator, joint, body, geom or world.
        coordinates: its parameters.
        shapes: `[k]`, whether a coordinate only shapes the effect.
        probes: starting points `[n, k]`, in the coordinates' units.
    """

    effect: str
    where: str
    kind: str
    coordinates: tuple[Coordinate, ...] = field(compare=False)
    shapes: tuple[bool, ...] = field(compare=False)
    probes: Array = field(repr=False, compare=False, hash=False, default_factory=lambda: np.zeros((0, 0)))

    @property
    def label(self) -> str:
        return f"{self.effect}@{self.where}"


def base_coordinates(
    space: ParameterSpace, accuracy: Mapping[str, float] | None = None, assumed: Collection[str] = ()
) -> tuple[Coordinate, ...]:
    """Return the parameters that the simulator already has, Gaussian where a data sheet states them, else nearly flat.

    Args:
        accuracy: {name: standard deviation as a share of the nominal value}, of those that a data sheet states.
        assumed: names of those whose accuracy nobody stated.
    """
    known = accuracy or {}

    def coordinate(i: int, p: Parameter) -> Coordinate:
        precision = _precision(p, known.get(p.name))
        own = Coordinate(p.name, (i,), p.nominal, p.low, p.high, precision, p.unit)
        if p.name in assumed:
            return replace(own, stated=True, kind=p.attribute)
        if p.name not in known or p.nominal == 0:
            return replace(own, stated=p.name in known)
        # what a motor's gain and all masses do alike, logs alone would let masses go anywhere
        far = RULES.far * precision**-0.5
        return replace(own, stated=True, low=max(p.low, p.nominal - far), high=min(p.high, p.nominal + far))

    return tuple(coordinate(i, p) for i, p in enumerate(space.parameters))


def _precision(p: Parameter, accuracy: float | None) -> float:
    if accuracy is not None and p.nominal != 0:
        return 1.0 / (accuracy * p.nominal) ** 2
    if p.prior == "gaussian" and p.sd:
        return 1.0 / p.sd**2
    return 1.0 / (0.58 * (p.high - p.low)) ** 2  # sd of a uniform prior, doubled: between the bounds nearly flat


def kinds_of(effects: str | Sequence[str | type[Effect]]) -> list[type[Effect]]:
    """Return the effects that are tried, those that act behind the others (`last`) at the end.

    "all", alone or among others: those of the library that are on offer (`offered`).

    Raises:
        UserError: an unknown effect, or a random one.
    """
    asked = [effects] if isinstance(effects, str) else effects
    found: list[type[Effect]] = []
    for name in asked:
        kinds = map(library.load, library.names()) if name == "all" else ()
        found += [kind for kind in kinds if kind.offered]
        found += [] if name == "all" else [library.load(name) if isinstance(name, str) else name]
    random = [kind.name for kind in found if kind.random]
    if random:  # a fit compares one deterministic motion with the log
        raise UserError(
            f"--effects {random[0]}: it is random, and fits are not; `bayessim-mjx logs check` reads it from the "
            "columns sent:command, received:command, sent:measurement and received:measurement; allowed: "
            "actuator_delay and sensor_delay, which find the mean"
        )
    return in_order(dict.fromkeys(found))


def stack(kinds: Sequence[type[Effect]], scales: Scales) -> tuple[tuple[Effect, ...], list[str]]:
    """One Effect per kind over all of its places, each with values and ranges of its own; and what is left out."""
    made, without = [], dict[str, list[str]]()
    for kind in kinds:
        every = places(kind, scales.model)
        found = tuple(p for p in every if _alive(kind, p, scales))
        own, whys = dict[str, tuple[Parameter, ...]](), list[str]()
        for place in found:
            try:
                own[place] = ranges(kind, place, scales)
            except UserError as error:  # a rotor at a site has no travel
                whys.append(str(error))
        if found and own:
            try:
                effect = kind(where=tuple(own), parameters=tuple(p for each in own.values() for p in each))
                effect.bind(scales.model, float(scales.model.opt.timestep), 1)
                made.append(effect)
                continue
            except UserError as error:
                whys.append(str(error))
        why = whys[0].removeprefix(f"{kind.name}: ") if found else f"these logs excite no suitable {kind.kind}"
        if found or (every and not kind.floats and not kind.loop):
            without.setdefault(why, []).append(kind.name)
    names = [scales.model.joint(int(j)).name for j in scales.model.dof_jntid]
    pairs = [(names[i], names[k]) for i, k in scales.follows.items()]
    one = [f"forces at {i}: it moves with {k} at a fixed ratio, so {k} stands for both" for i, k in pairs]
    return tuple(made), [*(f"{', '.join(names)}: {why}" for why, names in without.items()), *one]


def _alive(kind: type[Effect], place: str, scales: Scales) -> bool:
    """Joints that moved, not only with others; sensors that are read; contacts that are on; declared controllers."""
    model = scales.model
    if kind.loop:
        return bool(scales.loops[kind.loop][element_names(model, "actuator").index(place)])
    if kind.kind == "joint":
        joint = element_names(model, "joint").index(place)
        measures = kind.on_measurement is not Effect.on_measurement
        dof = int(model.jnt_dofadr[joint])
        return bool(scales.moves[dof] and (scales.read[dof] if measures else dof not in scales.follows))
    if kind.kind == "geom":
        geom = element_names(model, "geom").index(place)
        off = int(model.opt.disableflags) & int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
        return bool(model.geom_contype[geom] | model.geom_conaffinity[geom]) and not off
    return True


def enumerate_candidates(physics: Physics) -> list[Candidate]:
    """All candidates of a stack: each effect at each of its places; tied where there are several places."""
    out = []
    for effect in (e for e in physics.effects if e.quantities):
        blocks = physics.blocks_of(effect)
        out += [_candidate(effect, block.place, [block]) for block in blocks]
        if len(blocks) > 1 and effect.kind != "geom" and effect.tied:
            out.append(_candidate(effect, "all", blocks))
    return out


def _candidate(effect: Effect, where: str, blocks: Sequence[Block]) -> Candidate:
    coordinates = []
    for j, q in enumerate(effect.quantities):
        own = [block.parameters[j] for block in blocks]
        low, high = min(p.low for p in own), max(p.high for p in own)
        index = tuple(block.start + j for block in blocks)
        name = own[0].name if len(own) == 1 else f"all.{effect.name}.{q.name}"
        coordinates.append(Coordinate(name, index, own[0].nominal, low, high, unit=own[0].unit))
    believed = zip(coordinates, effect.quantities, strict=True)
    shown = tuple(
        replace(c, precision=STATED**2 * shrink(c), stated=True) if q.stated else replace(c, precision=shrink(c))
        for c, q in believed
    )
    shapes = tuple(q.shape for q in effect.quantities)
    return Candidate(effect.name, where, effect.kind, shown, shapes, _probes(effect, shown))


def shrink(c: Coordinate) -> float:
    """Return a half-normal of the range's width: it keeps numbers near neutral that no data identify."""
    return 1.0 / (c.high - c.low) ** 2


def _probes(effect: Effect, coordinates: Sequence[Coordinate]) -> Array:
    """Return starting points `[n, k]`: each amplitude alone at each grid value, shapes over their grids.

    Amplitudes that act together alone (`Effect.joint`) also in all combinations; shapes of a star (`Effect.star`) only
    one at a time.
    """
    quantities = effect.quantities
    neutral = [c.neutral for c in coordinates]
    values = [_grid(q, c) for q, c in zip(quantities, coordinates, strict=True)]
    shapes = [v if q.shape else [n] for q, v, n in zip(quantities, values, neutral, strict=True)]
    middle = [own[len(own) // 2] for own in shapes]

    def tried(point: tuple[float, ...]) -> bool:
        away = sum(q.shape and x != m for q, x, m in zip(quantities, point, middle, strict=True))
        return not effect.star or away < 2

    points: list[tuple[float, ...]] = []
    for j in (j for j, q in enumerate(quantities) if not q.shape):
        every = itertools.product(*(values[j] if i == j else own for i, own in enumerate(shapes)))
        points += filter(tried, every)
    return np.array(points + (list(itertools.product(*values)) if effect.joint else []))


def _grid(q: Quantity, c: Coordinate) -> list[float]:
    """Shapes: over the whole range. Amplitudes: from neutral, upwards where there is room (a secant has no sign)."""
    if q.shape:
        return [c.low + f * (c.high - c.low) for f in q.grid]
    end = c.high if c.high > c.neutral else c.low
    return [c.neutral + f * (end - c.neutral) for f in q.grid]
