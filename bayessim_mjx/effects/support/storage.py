"""effects.yaml: what a diagnosis found, for the loop.

    schema: 1
    effects: [{effect, where, parameters: {p: {nominal, mean, sd, range: [low, high], distribution: gaussian, unit}}}]
    calibrated: [{name, mean, sd, low, high, operation, attribute, target, kind ...}]

`parameters` is {place: {p: ...}} where `where` is a list of places. The nominal values are the identified means, so
that nominal physics is the corrected simulator; the priors are Gaussian, truncated to the ranges.
"""

import dataclasses
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from bayessim_mjx import config, trust
from bayessim_mjx import effects as room
from bayessim_mjx.distributions import Distribution
from bayessim_mjx.effects.effect import Effect
from bayessim_mjx.effects.support import reading
from bayessim_mjx.errors import UserError
from bayessim_mjx.parameters import Parameter, ParameterSpace, attributes
from bayessim_mjx.parameters.reading import own_value

if TYPE_CHECKING:
    import mujoco

HEADER = (
    "# What a diagnosis found. Use: bayessim-mjx main --task T effects={name}{code}\n"
    "# Calibrated numbers fit at the simulator's time step; the report's table and picture have those of the robot.\n"
)
LEAST_SD = 1e-6  # of the range
SURE = 3.0  # sd that a task's range is widened to hold
_FIELDS = [f.name for f in dataclasses.fields(Parameter) if f.name != "schedule"]

Identified = Distribution | Mapping[str, tuple[float, float]]


@dataclasses.dataclass(frozen=True)
class Correction:
    """What a diagnosis found.

    Attributes:
        effects: with nominal values and priors as identified.
        calibrated: parameters of the model, with nominal, mean and sd as identified.
    """

    effects: tuple[Effect, ...]
    calibrated: tuple[Parameter, ...]


def write(
    path: str | Path,
    effects: Sequence[Effect],
    identified: Identified,
    calibrated: ParameterSpace = ParameterSpace(),  # noqa: B008  # immutable
) -> Path:
    """Write an effects.yaml.

    Args:
        effects: those found, in the order of their hooks.
        identified: a distribution over the parameters of `calibrated` and of the effects (and maybe others), or
            {parameter name: (mean, sd)}.
        calibrated: parameters of the model that were recalibrated.

    Raises:
        UserError: `identified` lacks a parameter.
    """
    found = _moments(identified)
    plain = {
        "schema": config.EFFECTS_SCHEMA,
        "effects": [_entry(effect, found) for effect in effects],
        "calibrated": [_calibrated_entry(_identified(p, found)) for p in calibrated.parameters],
    }
    path = Path(path)
    files = dict.fromkeys(spec.rpartition(":")[0] for e in effects if ".py:" in (spec := room.spec_of(e)))
    code = "".join(f" {trust.FLAG} {file}" for file in files)
    path.write_text(HEADER.format(name=path.name, code=code) + config.to_yaml(plain), encoding="utf-8")
    return path


def _moments(identified: Identified) -> dict[str, tuple[float, float]]:
    if isinstance(identified, Distribution):
        return {name: (row["mean"], row["sd"]) for name, row in identified.describe().items()}
    return {name: (float(mean), float(sd)) for name, (mean, sd) in identified.items()}


def _identified(p: Parameter, found: Mapping[str, tuple[float, float]]) -> Parameter:
    """Set the parameter's nominal value and prior as identified, inside its range."""
    if p.name not in found:
        raise UserError(f"effects.yaml: no value of {p.name}; there are: {', '.join(found) or 'none'}")
    mean, sd = found[p.name]
    return _gaussian(p, mean, sd)


def _gaussian(p: Parameter, mean: float, sd: float) -> Parameter:
    if not (np.isfinite(mean) and np.isfinite(sd)):
        raise UserError(f"effects.yaml: {p.name} = {mean} with sd {sd}: must be finite")
    mean, sd = (float(f"{v:.7g}") for v in (mean, max(sd, LEAST_SD * (p.high - p.low))))
    mean = min(max(mean, p.low), p.high)
    return dataclasses.replace(p, nominal=mean, prior="gaussian", mean=mean, sd=sd)


def _entry(effect: Effect, found: Mapping[str, tuple[float, float]]) -> dict[str, Any]:
    places = {b.place: {p.attribute: _setting(_identified(p, found)) for p in b.parameters} for b in effect.blocks()}
    single = isinstance(effect.where, str)
    fields = [f for f in dataclasses.fields(effect) if f.name not in ("where", "parameters")]
    own = {f.name: getattr(effect, f.name) for f in fields if getattr(effect, f.name) != f.default}
    where = effect.where if single else list(effect.where)
    parameters = places[effect.places()[0]] if single else places
    return {"effect": room.spec_of(effect), "where": where, **own, "parameters": parameters}


def _setting(p: Parameter) -> dict[str, Any]:
    given = {"nominal": p.nominal, "mean": p.mean, "sd": p.sd, "range": [p.low, p.high], "distribution": p.prior}
    return given | {"unit": p.unit}


def _calibrated_entry(p: Parameter) -> dict[str, Any]:
    plain = {name: getattr(p, name) for name in _FIELDS}
    return plain | {"axis": None if p.axis is None else [float(a) for a in p.axis]}


def read(path: str | Path) -> Correction:
    """Read an effects.yaml.

    Raises:
        UserError: naming the file, the key, and what is allowed.
    """
    raw = config.read_effects(path)
    for key, kind in (("effects", list), ("calibrated", list)):
        if not isinstance(raw[key], kind):
            raise UserError(f"{path}: {key} = {raw[key]!r}: expected a list")
    try:
        return Correction(reading.listed(raw["effects"]), calibrated(raw["calibrated"]))
    except UserError as error:
        raise UserError(f"{path}: {error}") from None


def calibrated(specs: Iterable[Any]) -> tuple[Parameter, ...]:
    """Read the parameters of a list `calibrated:`.

    Raises:
        UserError: naming the entry, and what is wrong in it.
    """
    return tuple(_parameter(spec, f"calibrated[{i}]") for i, spec in enumerate(specs))


def _parameter(spec: Any, path: str) -> Parameter:
    if not isinstance(spec, Mapping):
        raise UserError(f"{path} = {spec!r}: expected {{name, mean, sd, low, high, kind, attribute, target ...}}")
    for key in spec:
        if key not in _FIELDS:
            raise config.unknown(f"{path}: key", str(key), _FIELDS)
    for key in ("name", "mean", "sd", "low", "high", "kind", "attribute", "target"):
        if spec.get(key) is None:
            raise UserError(f"{path}.{key} is missing in {dict(spec)}")
    numbers = {k: reading.checks.number(spec[k], f"{path}.{k}") for k in ("mean", "sd", "low", "high")}
    axis = None if spec.get("axis") is None else tuple(float(a) for a in spec["axis"])
    given: dict[str, Any] = {**spec, **numbers, "axis": axis, "prior": "gaussian", "nominal": numbers["mean"]}
    try:
        return Parameter(**given)
    except UserError as error:
        raise UserError(f"{path}: {error}") from None


def corrected(
    spec: "mujoco.MjSpec", section: Mapping[str, Any], calibrated: Sequence[Parameter]
) -> tuple["mujoco.MjSpec", "mujoco.MjModel", ParameterSpace]:
    """(spec, model, space) of a task with what was calibrated.

    Where the task randomises the same number of the same element, its parameter gets the identified nominal value and
    prior (its range is widened where it must be to hold them); what the task does not randomise is written into the
    model.

    Args:
        spec: of the nominal model; not changed.
        section: the task's `randomization_params`.

    Raises:
        UserError: an element is not in the model, or the section is wrong.
    """
    model = spec.compile()
    space = ParameterSpace.from_config(section, model)
    if not calibrated:
        return spec, model, space
    found = {_number(model, p): p for p in calibrated}
    shared = {_number(model, p) for p in space.parameters} & set(found)
    known = [_merged(p, found.get(_number(model, p)), model) for p in space.parameters]
    fixed = [p for key, p in found.items() if key not in shared]
    if fixed:
        spec = ParameterSpace(fixed).edit(spec, [p.nominal for p in fixed])
        model = spec.compile()
    return spec, model, ParameterSpace(known)


def _number(model: "mujoco.MjModel", p: Parameter) -> tuple[str, str, str | int]:
    """Which number of the model a parameter changes."""
    if p.kind not in attributes.OBJECTS:
        return p.kind, p.attribute, p.target
    try:
        return p.kind, p.attribute, attributes.element(model, p.kind, p.target)
    except UserError as error:
        raise UserError(f"calibrated {p.name}: {error}") from None


def _merged(own: Parameter, found: Parameter | None, model: "mujoco.MjModel") -> Parameter:
    """Merge the task's parameter with what was identified, in the task's units."""
    if found is None:
        return own
    assert found.mean is not None and found.sd is not None
    slope, offset = 1.0, 0.0
    if (own.operation, own.factor) != (found.operation, found.factor):
        (a, b), (c, d) = _line(found, model), _line(own, model)
        slope, offset = a / c, (b - d) / c
    mean, sd = slope * found.mean + offset, abs(slope) * found.sd
    ends = sorted(slope * end + offset for end in (found.low, found.high))
    low = min(own.low, max(ends[0], mean - SURE * sd))
    high = max(own.high, min(ends[1], mean + SURE * sd))
    return _gaussian(dataclasses.replace(own, low=low, high=high), mean, sd)


def _line(p: Parameter, model: "mujoco.MjModel") -> tuple[float, float]:
    """(slope, offset) of the model's number as a function of theta."""
    own = own_value(model, p.kind, p.attribute, p.target)
    return {"scaling": (own, 0.0), "additive": (p.factor, own), "absolute": (p.factor, 0.0)}[p.operation]
