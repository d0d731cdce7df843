"""How much of a motion may stay unexplained before it matters, per degree of freedom, and what was asked for."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray

from bayessim_mjx.errors import UserError
from bayessim_mjx.logs.log import Channels
from bayessim_mjx.parameters.attributes import suggest
from bayessim_mjx.quantities import extent

Array = NDArray[np.float64]


# What may stay unexplained where no user says so: the larger of so many noise sd and of this share of the range of
# motion. Rules of thumb, not measured.
NOISES, SHARE = 3.0, 0.02
UNITS = {"rad": {"rad": 1.0, "mrad": 1e-3, "deg": math.pi / 180}, "m": {"m": 1.0, "cm": 1e-2, "mm": 1e-3}}
_FORM = re.compile(r"(?P<value>[0-9.]+(?:e[+-]?[0-9]+)?)\s*(?P<unit>%|[a-z]*)")


@dataclass(frozen=True)
class Limit:
    """One tolerance as it was typed: `value` in rad or m, or a share of the range of motion."""

    value: float
    relative: bool


@dataclass(frozen=True, eq=False)
class Tolerance:
    """What may remain, per degree of freedom.

    Attributes:
        names, units: `[nv]`, channels and "rad" or "m".
        limit: `[nv]`, rad or m.
        motion: `[nv]`, range of motion in the logs; noise: `[nv]`, what counts as noise; rad or m.
        given: `[nv]`, whether the user said so.
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    limit: Array
    motion: Array
    noise: Array
    given: NDArray[np.bool_]

    def warnings(self) -> list[str]:
        """Tolerances that the noise hides."""
        return [
            f"--tolerance {n}: {extent(t, u)} is below the noise of {extent(s, u)}: what is smaller cannot be told, "
            "the noise is taken"
            for n, u, t, s, own in zip(self.names, self.units, self.limit, self.noise, self.given, strict=True)
            if own and t < s and math.isfinite(s)
        ]

    def measured(self) -> list[tuple[int, str]]:
        """(degree of freedom, channel) of the positions that were measured: of others no gap is told."""
        return [(i, n) for i, n in enumerate(self.names) if math.isfinite(self.noise[i])]

    def by_dof(self, channels: Array) -> Array:
        """The positions among measured channels `[..., channels]` as `[..., nv]`; NaN where none was measured."""
        seen = np.isfinite(self.noise)
        if seen.all():
            return channels[..., : len(seen)]
        out = np.full((*channels.shape[:-1], len(seen)), np.nan)
        out[..., seen] = channels[..., : int(seen.sum())]
        return out

    def exceeded(self, rms: Array) -> NDArray[np.bool_]:
        """`[nv]`, where a root mean square error `[nv]` (rad or m) leaves more than tolerated above the noise."""
        return np.asarray(above_noise(rms, self.noise) > np.maximum(self.limit, self.noise))


def above_noise(rms: Array | float, noise: Array | float) -> Array:
    """Root mean square errors without the noise's part; all in one unit."""
    return np.asarray(np.sqrt(np.maximum(np.square(rms) - np.square(noise), 0.0)))


def length_unit(model: mujoco.MjModel, dof: int) -> str:
    """rad or m."""
    joint = int(model.dof_jntid[dof])
    free = int(model.jnt_type[joint]) == int(mujoco.mjtJoint.mjJNT_FREE)
    slides = int(model.jnt_type[joint]) == int(mujoco.mjtJoint.mjJNT_SLIDE)
    return "m" if slides or (free and dof - int(model.jnt_dofadr[joint]) < 3) else "rad"


def read(texts: Sequence[str], model: mujoco.MjModel) -> dict[int, Limit]:
    """{degree of freedom: limit} of what was typed: `0.5deg`, `2%` for all joints, `elbow=0.5deg`, with commas too.

    A number without a unit is in rad or m. What names a joint goes before what names none.

    Raises:
        UserError: unknown joints, units that the joint has not, numbers that are not positive.
    """
    channels = Channels.of(model)
    parts = [p.strip() for text in texts for p in text.split(",") if p.strip()]
    out: dict[int, Limit] = {}
    for part in sorted(parts, key=lambda p: "=" in p):
        name, _, value = part.rpartition("=")
        own = [v for v, n in enumerate(channels.qvel) if not name or n == name or n.startswith(f"{name}[")]
        if not own:
            raise UserError(f"--tolerance {part}: no joint {name!r}; {suggest(name, channels.joints)}")
        for dof in own:
            out[dof] = _limit(part, value, length_unit(model, dof), channels.qvel[dof])
    return out


def _limit(part: str, text: str, kind: str, joint: str) -> Limit:
    found = _FORM.fullmatch(text.strip())
    allowed = f"a number with {', '.join(UNITS[kind])} or % (of the range of motion), as in {joint}=2%"
    if found is None:
        raise UserError(f"--tolerance {part}: {text!r} is no number; allowed: {allowed}")
    unit, relative = found["unit"] or kind, found["unit"] == "%"
    if not relative and unit not in UNITS[kind]:
        raise UserError(f"--tolerance {part}: {joint} is measured in {kind}, not in {unit}; allowed: {allowed}")
    try:
        value = float(found["value"]) * (0.01 if relative else UNITS[kind][unit])
    except ValueError:
        raise UserError(f"--tolerance {part}: {text!r} is no number; allowed: {allowed}") from None
    if not 0 < value < math.inf:
        raise UserError(f"--tolerance {part}: {text} is not positive; allowed: {allowed}")
    return Limit(value, relative)


def judge(model: mujoco.MjModel, motion: Array, noise: Array, asked: dict[int, Limit]) -> Tolerance:
    """The tolerance of every degree of freedom: as asked for, else the larger of NOISES sd and SHARE of the motion.

    Args:
        motion, noise: `[nv]`, range of motion and standard deviation of the noise, rad or m.
    """
    limit = np.maximum(NOISES * noise, SHARE * motion)
    for dof, own in asked.items():
        limit[dof] = own.value * motion[dof] if own.relative else own.value
    given = np.isin(np.arange(model.nv), list(asked))
    units = tuple(length_unit(model, v) for v in range(model.nv))
    return Tolerance(Channels.of(model).qvel, units, limit, np.asarray(motion, float), np.asarray(noise, float), given)
