"""What a data sheet states of a robot: how accurate its numbers are, and what it is rated to carry."""

from __future__ import annotations

import fnmatch
import math
import re
from collections.abc import Iterator, Mapping, Sequence

import mujoco
from scipy.special import stdtrit

from bayessim_mjx.effects.support.site import element_names
from bayessim_mjx.errors import UserError
from bayessim_mjx.parameters import ParameterSpace
from bayessim_mjx.parameters.attributes import suggest

# The accuracy of numbers for which nobody states one is inferred, one for each kind (masses, armatures, dampings,
# frictions). Prior of its square: scaled inverse chi-squared, SURE degrees of freedom around ACCURACY. The error of one
# number is then a Student t. Its median, 90 % and 95 % ranges (.057, .20, .30) are close to those of normal errors with
# a standard deviation from 2 to 30 %, log-uniform (.046, .21, .29).
# On fresh cases whose data sheets are 2 to 30 % off, 92 % of the known parameters lie in their 90 % intervals (1247 of
# 1350, benchmarks/records/diagnosis_fresh.json).
ACCURACY = 0.07  # share of the stated value; source: the record above
SURE = 2.0  # degrees of freedom; source: the record above
WORST = ACCURACY * float(stdtrit(SURE, 0.975))  # .30, end of the 95 % range: a worse data sheet is another robot's
# What drives have that models leave out or guess: where inertia, damping and friction are all larger than modelled,
# one number of a gain takes their place, and one by one none of them does. Not counted: docs/decisions/drive_laws.md
DRIVES = ("coulomb_friction", "viscous_friction", "armature")
FORM = re.compile(r"(?P<value>[-+]?[0-9.]+(?:e[-+]?[0-9]+)?)\s*(?P<unit>%|[a-z]*)")


def accuracies(texts: Sequence[str], space: ParameterSpace, default: float | None) -> dict[str, float]:
    """{parameter: standard deviation as a share of its nominal value} of `5%`, `mass=2%`, `elbow*=20%`, also in one.

    A name is one of a parameter, of what it changes (mass, damping, armature, friction) or of the element that has it,
    or a pattern. Named ones go before those for all, later ones before earlier ones. A parameter whose own prior is
    Gaussian keeps that.

    Args:
        default: of what nothing is said of; None: nothing is stated of it.

    Raises:
        UserError: no such parameter, or no share above 0.
    """
    own = {p.name: default for p in space.parameters if default is not None and _open(p)}
    for part, name, value in assigned(texts):
        allowed = "a share above 0, as in 5% or mass=2%"
        share, unit = measure(f"--accuracy {part}", value, {"%": 0.01, "": 1.0}, allowed)
        if not unit and share > 1:
            raise UserError(
                f"--accuracy {part}: {value} is {100 * share:g} %; did you mean {value}%? allowed: {allowed}"
            )
        named = [p.name for p in space.parameters if not name or _called(p, name)]
        if not named:
            every = [*dict.fromkeys(p.attribute for p in space.parameters), *space.names]
            raise UserError(f"--accuracy {part}: no known parameter {name!r}; {suggest(name, every)}")
        own |= {p.name: share for p in space.parameters if p.name in named and (name or _open(p))}
    return {name: float(share) for name, share in own.items() if share is not None}


def _open(p: object) -> bool:
    """Whether a parameter leaves its accuracy to be stated."""
    return getattr(p, "prior", "") != "gaussian" and getattr(p, "nominal", 0.0) != 0.0


def _called(p: object, name: str) -> bool:
    return any(fnmatch.fnmatchcase(str(getattr(p, k)), name) for k in ("name", "attribute", "target"))


def rating(texts: Sequence[str], model: mujoco.MjModel) -> dict[int, float]:
    """{body: kg} that a robot is rated to carry: `12kg` on every body that moves, `tool=12` on one.

    Raises:
        UserError: no such body, or no mass above 0.
    """
    moving = [b for b in range(1, model.nbody) if model.body_weldid[b] != 0]
    names = {element_names(model, "body")[b]: b for b in moving}
    out: dict[int, float] = {}
    for part, name, value in assigned(texts):
        allowed = "a mass above 0 in kg, as in 12kg or tool=12kg"
        mass, _ = measure(f"--payload {part}", value, {"kg": 1.0, "": 1.0}, allowed)
        if name and name not in names:
            raise UserError(f"--payload {part}: no moving body {name!r}; {suggest(name, names)}")
        out |= dict.fromkeys([names[name]] if name else moving, mass)
    return out


def assigned(texts: Sequence[str]) -> Iterator[tuple[str, str, str]]:
    """Split `5%`, `mass=2%`, also in one text with commas, into (part, name or "", value); values for all first."""
    parts = [p.strip() for text in texts for p in text.split(",") if p.strip()]
    for part in sorted(parts, key=lambda p: "=" in p):
        name, _, value = part.rpartition("=")
        yield part, name, value


def measure(flag: str, text: str, units: Mapping[str, float], allowed: str, has: str = "") -> tuple[float, str]:
    """(value in the unit of the factors, unit as typed) of `5mm`.

    Args:
        flag: with its value, as typed. units: {unit: factor}; with "" among them a number may stand alone.
        allowed: values in words; has: the units that there are, in words.

    Raises:
        UserError: no number, no such unit, or no number above 0.
    """
    found = FORM.fullmatch(text.strip())
    try:
        value = float(found["value"]) if found else math.nan
    except ValueError:
        value = math.nan
    if not found or math.isnan(value):
        raise UserError(f"{flag}: {text!r} is no number; allowed: {allowed}")
    if found["unit"] not in units:
        why = f"{has}, not in {found['unit']}" if found["unit"] and has else f"{text} has no such unit"
        raise UserError(f"{flag}: {why if found['unit'] else f'{text} has no unit'}; allowed: {allowed}")
    if not 0 < value < math.inf:
        raise UserError(f"{flag}: {text} is not above 0; allowed: {allowed}")
    return value * units[found["unit"]], found["unit"]
