"""A diagnosis as a simulator: effects and parameters at their identified values, their uncertainty as a prior.

Only names, places and estimates are read, so a diagnosis loaded from its folder serves as well as a fresh one.
"""

from __future__ import annotations

import copy
import dataclasses
import math
from collections.abc import Sequence
from typing import Any, Protocol

import mujoco
import numpy as np

from bayessim_mjx import effects as library
from bayessim_mjx import quantities
from bayessim_mjx.distributions import Distribution
from bayessim_mjx.effects.effect import Effect, Quantity, in_order, layout
from bayessim_mjx.effects.support import storage
from bayessim_mjx.errors import UserError
from bayessim_mjx.parameters import Parameter, ParameterSpace
from bayessim_mjx.physics import Physics


@dataclasses.dataclass(frozen=True, repr=False)
class Estimate:
    """One identified number.

    Attributes:
        mean, sd: value and standard deviation, in `unit`. sd is NaN at a bound, except "off".
        bound: "" inside the range. An effect's range doubles while held-out evidence gains from it, up to a hundred
            times. "at least", "at most": the estimate ends where nothing larger or smaller was tried. "end": physics
            ends there, or a wider range explains no more. "off": the number has no part in the effect.
        allowed: the part of `sd` that allows for other simulators, whatever the data (`numbers.Priors`).
    """

    mean: float
    sd: float
    unit: str = ""
    bound: str = ""
    allowed: float = 0.0

    def __repr__(self) -> str:
        """`0.1191 +- 0.0016 N m`: rounded by the standard deviation, also inside of `FoundEffect.parameters`."""
        return f"{quantities.estimate(self.mean, self.sd).replace('±', '+-')} {self.unit}".rstrip()


@dataclasses.dataclass(frozen=True)
class FoundEffect:
    """An effect that reality has and the simulator has not.

    Attributes:
        name, where: of the library, of the model.
        parameters: {parameter: Estimate}.
        weight_among_rivals: probability of this effect beside `equivalent_to`, 1 together. What is there may be none
            of them. NaN where there is no rival.
        gap_closed, gap_closed_ci: its part of what all effects close, as a share of the recalibrated simulator's
            squared gap above the noise, on held-out windows, with a 90 % interval (NaN of one condition).
        equivalent_to: [{"effects": ["payload@link", ...], "gap_closed": ..., "why": sentence, "weight": probability
            among the rivals}], which these logs cannot tell from it; of an effect that contains it as a special case,
            no weight.
        shared: {"effects": labels, "mean", "low", "high", "unit", "quantities"}: how large it is, whichever of these
            effects it is (mixture of their posteriors by probability, 90 % interval); {} where they share no unit.
        sentence: for people; predicted_gap_closed: the same share as promised before any effect was fitted.
        share: of the gap closed by all effects together (Shapley).
        modelled: {parameter: the model's own number that it multiplies}, of a servo's gains.
    """

    name: str
    where: str
    parameters: dict[str, Estimate]
    weight_among_rivals: float
    gap_closed: float
    gap_closed_ci: tuple[float, float]
    equivalent_to: list[dict[str, Any]] = dataclasses.field(default_factory=list)
    sentence: str = ""
    predicted_gap_closed: float = math.nan
    share: float = math.nan
    shared: dict[str, Any] = dataclasses.field(default_factory=dict)
    modelled: dict[str, float] = dataclasses.field(default_factory=dict)


REACH = 4.0  # sd that a range holds on both sides, where physics allows: all but 6e-5 of a Gaussian; source: its tails
LEAST_SD = float(np.finfo(np.float32).eps)  # of the range: a prior needs a width that float32 can resolve
UNIFORM = 1 / math.sqrt(12)  # standard deviation of a uniform law, of its range
OWN_EFFECTS = "effect_specs"  # in `Diagnosis.details`: {name: path.py:MyEffect} of effects that are not the library's


class Found(Protocol):
    """What is read of a diagnosis (`result.Diagnosis`)."""

    @property
    def effects(self) -> list[FoundEffect]: ...
    @property
    def parameters(self) -> dict[str, dict[str, Any]]: ...
    @property
    def covariance(self) -> dict[str, Any]: ...
    @property
    def details(self) -> dict[str, Any]: ...
    @property
    def gap(self) -> Any: ...


@dataclasses.dataclass(frozen=True)
class Stepping:
    """How a diagnosis simulated, where that is not as the model was delivered.

    Attributes:
        integrator, timestep: name in an MJCF, and s. own, own_step: the delivered ones.
    """

    integrator: str
    timestep: float
    own: str
    own_step: float

    @property
    def number(self) -> int:
        """MuJoCo's, of the integrator."""
        return int(getattr(mujoco.mjtIntegrator, f"mjINT_{self.integrator.upper()}"))


def stepping_of(diagnosis: Found) -> Stepping | None:
    """Return how it simulated; None where that is as delivered, or not known (files of before)."""
    step = diagnosis.gap.integrator
    if "delivered" not in step:
        return None
    found = Stepping(step["integrator"], step["substep"], step["delivered"], step["timestep"])
    same = found.integrator == found.own and found.timestep > found.own_step * (1 - quantities.EXACT)
    return None if same else found


def effects_of(diagnosis: Found) -> tuple[Effect, ...]:
    """Return the effects found, with nominal = identified mean and prior Gaussian(mean, sd), truncated to a range.

    One effect at several places is one `Effect` with values of its own at each; "all" is tied. Their order is the
    library's, as in the diagnosis (`in_order`).

    Raises:
        UserError: an unknown effect, or an estimate that is missing or no number.
    """
    places: dict[tuple[str, bool], list[FoundEffect]] = {}
    for found in diagnosis.effects:
        places.setdefault((found.name, found.where == "all"), []).append(found)
    order = library.names()
    keys = sorted(places, key=lambda key: order.index(key[0]) if key[0] in order else len(order))
    own = diagnosis.details.get(OWN_EFFECTS, {})
    return tuple(in_order(_effect(library.recorded(own.get(key[0], key[0])), places[key]) for key in keys))


def _effect(kind: type[Effect], found: list[FoundEffect]) -> Effect:
    where = found[0].where if len(found) == 1 else tuple(f.where for f in found)
    used = [q for q in kind.quantities if not q.optional or any(_acts(q, f.parameters.get(q.name)) for f in found)]
    estimates = [e for f in found for e in _in_order([q.name for q in used], f)]
    pairs = ((p, q) for block in kind(where=where).with_all().blocks() for p, q in block.pairs() if q in used)
    identified = (_identified(p, q, e) for (p, q), e in zip(pairs, estimates, strict=True))
    return kind(where=where, parameters=tuple(identified))


def _acts(q: Quantity, e: Estimate | None) -> bool:
    return e is not None and e.bound != "off" and e.mean != q.neutral


def _in_order(names: Sequence[str], found: FoundEffect) -> list[Estimate]:
    """Return the estimates of one place in the order of the effect's quantities."""
    for name in names:
        if name not in found.parameters or not math.isfinite(found.parameters[name].mean):
            have = ", ".join(found.parameters) or "none"
            raise UserError(f"diagnosis: {found.name} at {found.where}: no value of {name}; it has {have}")
    return [found.parameters[name] for name in names]


def _identified(p: Parameter, q: Quantity, e: Estimate) -> Parameter:
    """Return the effect's parameter as identified; the library's range is widened where it must be."""
    # at a bound: uniform from neutral to twice as far
    sd = e.sd if math.isfinite(e.sd) else UNIFORM * 2 * abs(e.mean - q.neutral)
    low, high = min(p.low, e.mean - REACH * sd), max(p.high, e.mean + REACH * sd)
    if q.low == q.neutral:  # beyond it the physics has no meaning
        low = p.low
    elif p.low > 0:  # a gain, a frequency: it stays positive
        low = max(low, min(p.low, 0.5 * e.mean)) if e.mean > 0 else p.low
    if q.high == q.neutral:
        high = p.high
    return _gaussian(dataclasses.replace(p, low=low, high=high, unit=e.unit or p.unit), e.mean, sd)


def _gaussian(p: Parameter, mean: float, sd: float) -> Parameter:
    mean = min(max(mean, p.low), p.high)
    return dataclasses.replace(p, nominal=mean, prior="gaussian", mean=mean, sd=max(sd, LEAST_SD * (p.high - p.low)))


def calibrated_of(diagnosis: Found, space: ParameterSpace) -> ParameterSpace:
    """`space` with the values that fit at the simulator's time step as nominal, and Gaussian priors about them.

    Parameters that were not calibrated stay as they are.

    Raises:
        UserError: the diagnosis calibrated a parameter that `space` has not.
    """
    for name in diagnosis.parameters:
        space.index(name)
    return ParameterSpace(_calibrated(p, diagnosis.parameters.get(p.name)) for p in space.parameters)


def _calibrated(p: Parameter, found: dict | None) -> Parameter:
    estimate = found or {}
    mean, sd = _number(estimate.get("simulated", estimate.get("mean"))), _number(estimate.get("sd"))
    if math.isnan(mean):
        return p
    wide = dataclasses.replace(p, low=min(p.low, mean), high=max(p.high, mean))
    return _gaussian(wide, mean, UNIFORM * (p.high - p.low) if math.isnan(sd) else sd)


def _number(value: float | None) -> float:
    return math.nan if value is None or not math.isfinite(value) else float(value)


def apply(diagnosis: Found, physics: Physics) -> Physics:
    """Return the corrected simulator: the same model and control step; nominal values are the identified ones.

    Its integrator and its time step are those by which the diagnosis simulated: errors of others were not measured.

    Args:
        physics: with the known parameters as its `model_space`; its effects are replaced by those found.

    Raises:
        UserError: an effect's place, or a calibrated parameter, is not in this model.
    """
    limit = None if physics.max_qvel is None else physics.max_qvel.tolist()
    space = calibrated_of(diagnosis, physics.model_space)
    return Physics(_stepping(physics, stepping_of(diagnosis)), physics.dt, space, effects_of(diagnosis), limit)


def _stepping(physics: Physics, found: Stepping | None) -> mujoco.MjModel:
    """Return the model with an integrator, and a time step that is no longer and divides the control step."""
    if found is None:
        return physics.mj_model
    model = copy.copy(physics.mj_model)
    step = min(found.timestep, float(model.opt.timestep))
    model.opt.integrator = found.number
    model.opt.timestep = physics.dt / math.ceil(physics.dt / step - quantities.EXACT)
    return model


def prior(diagnosis: Found, physics: Physics | ParameterSpace | None = None) -> Distribution:
    """Return the distribution of the corrected simulator's theta: jointly Gaussian, truncated to the ranges.

    Where a diagnosis brings no covariance, the parameters are independent. Else the distribution's space has the names
    and ranges of the corrected simulator's, but uniform priors: over those a Gaussian is exact.

    Args:
        physics: the simulator that was diagnosed, or the space of its known parameters; None: the diagnosis's own
            record of them, enough to draw theta for `apply(diagnosis, physics)`.
    """
    if physics is None:
        known = ParameterSpace(_recorded(name, row) for name, row in diagnosis.parameters.items())
    else:
        known = physics.model_space if isinstance(physics, Physics) else physics
    blocks = layout(calibrated_of(diagnosis, known), effects_of(diagnosis))
    space = ParameterSpace(p for block in blocks for p in block.parameters)
    return _jointly(diagnosis.covariance, space) if diagnosis.covariance else Distribution.prior(space)


def _jointly(covariance: dict, space: ParameterSpace) -> Distribution:
    """Gaussian at nominal theta; parameters without a covariance are as wide as their ranges."""
    flat = ParameterSpace(dataclasses.replace(p, prior="uniform", mean=None, sd=None) for p in space.parameters)
    width = np.asarray(space.high, float) - np.asarray(space.low, float)
    matrix = np.diag(width**2 / 12)
    found = [n for n in covariance["names"] if n in space.names]
    at = [space.index(n) for n in found]
    of = [covariance["names"].index(n) for n in found]
    known = np.asarray(covariance["matrix"], float)[np.ix_(of, of)]
    least = (LEAST_SD * width[at]) ** 2
    matrix[np.ix_(at, at)] = known + np.diag(np.maximum(least - np.diag(known), 0.0))
    return Distribution.gaussian(flat, np.asarray(space.nominal, float), matrix)


def _recorded(name: str, row: dict) -> Parameter:
    """Return a known parameter by its record in diagnosis.json; it cannot be written into a model."""
    return Parameter(name, row["nominal"], row["low"], row["high"], unit=row.get("unit") or "")


def correction(diagnosis: Found, space: ParameterSpace) -> storage.Correction:
    """Return the effects found, and those parameters of `space` that were calibrated: the contents of effects.yaml."""
    known = calibrated_of(diagnosis, space).parameters
    return storage.Correction(effects_of(diagnosis), tuple(p for p in known if p not in space.parameters))
