"""A request for a diagnosis, and the errors that may stay unexplained at each degree of freedom."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np
from numpy.typing import NDArray

from bayessim_mjx.diagnosis.data_sheet import assigned, measure
from bayessim_mjx.diagnosis.selection.search_state import Settings
from bayessim_mjx.diagnosis.statistics import above_noise
from bayessim_mjx.effects.effect import Effect
from bayessim_mjx.errors import UserError
from bayessim_mjx.logs.log import Channels
from bayessim_mjx.parameters.attributes import suggest
from bayessim_mjx.quantities import listed

Array = NDArray[np.float64]
Effects = str | Sequence[str | type[Effect]]

# What may stay unexplained where no user says so: the larger of so many noise sd and of this share of the range of
# motion. Rules of thumb, not measured.
NOISES, SHARE = 3.0, 0.02
UNITS = {"rad": {"deg": math.pi / 180, "mrad": 1e-3, "rad": 1.0}, "m": {"mm": 1e-3, "cm": 1e-2, "m": 1.0}}
RELATIVE = {"%": 0.01}


@dataclass(frozen=True)
class Request:
    """What is to be diagnosed, beside the robot and the logs.

    Attributes:
        effects: "all", or names or classes of the effects that are tried.
        group: metadata key of the logs that names their operating condition; None: each log is one.
        seed: of all random numbers.
        settings: sizes of the search; None: by the robot's size.
        minutes: that the diagnosis may take; None: no limit.
        quick: a first answer from few windows, without the optional stages.
        verdict_only: without the optional stages.
        tolerances: errors that may stay unexplained, as the command's flag: "0.5deg", "elbow=2mm", "3%".
        notes: warnings from reading model and logs; they come first among the warnings.
        remember: folder for the fits of the search, from which an interrupted search continues; None: none is kept.
    """

    effects: Effects = "all"
    group: str | None = None
    seed: int = 0
    settings: Settings | None = None
    minutes: float | None = None
    quick: bool = False
    verdict_only: bool = False
    tolerances: Sequence[str] = ()
    notes: Sequence[str] = ()
    remember: Path | None = None


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

    def measured(self) -> list[tuple[int, str]]:
        """(degree of freedom, channel) of the positions that were measured: of others no gap is known."""
        return [(i, n) for i, n in enumerate(self.names) if math.isfinite(self.noise[i])]

    def by_dof(self, channels: Array) -> Array:
        """Return the positions among measured channels `[..., channels]` as `[..., nv]`; NaN where there is none."""
        seen = np.isfinite(self.noise)
        out = np.full((*channels.shape[:-1], len(seen)), np.nan)
        out[..., seen] = channels[..., : int(seen.sum())]
        return out

    def exceeded(self, rms: Array) -> NDArray[np.bool_]:
        """`[nv]`, where a root mean square error `[nv]` (rad or m) leaves more than tolerated above the noise."""
        return np.asarray(above_noise(rms, self.noise) > np.maximum(self.limit, self.noise))


def length_unit(model: mujoco.MjModel, dof: int) -> str:
    """Name the unit of a degree of freedom: rad or m."""
    joint = int(model.dof_jntid[dof])
    free = int(model.jnt_type[joint]) == int(mujoco.mjtJoint.mjJNT_FREE)
    slides = int(model.jnt_type[joint]) == int(mujoco.mjtJoint.mjJNT_SLIDE)
    return "m" if slides or (free and dof - int(model.jnt_dofadr[joint]) < 3) else "rad"


def tolerances(texts: Sequence[str], model: mujoco.MjModel) -> Callable[[Array, Array], Tolerance]:
    """Read what was typed, `0.5deg`, `2%` for all joints, `elbow=0.5deg`, with commas too: `judge` with these limits.

    A joint's own limit goes before that of all joints.

    Raises:
        UserError: an unknown joint, a missing unit or one that the joint has not, a number that is not above 0.
    """
    channels, given = Channels.of(model), dict[int, Limit]()
    kinds = [length_unit(model, v) for v in range(model.nv)]
    judged = functools.partial(judge, model, given)
    for part, name, text in assigned(texts):
        own = [v for v, n in enumerate(channels.qvel) if not name or n == name or n.startswith(f"{name}[")]
        if not own:
            raise UserError(f"--tolerance {part}: no joint {name!r}; {suggest(name, channels.joints)}")
        for dof in own:
            units = UNITS[kinds[dof]] | RELATIVE
            examples = listed([f"5{unit}" for unit in units], "or")
            allowed = f"a number above 0 with a unit: {examples} of the range of motion"
            has = f"{channels.qvel[dof]} is in {listed(list(units), 'or')}"
            value, unit = measure(f"--tolerance {part}", text, units, allowed, has)
            given[dof] = Limit(value, unit in RELATIVE)
    return judged


def judge(model: mujoco.MjModel, given: Mapping[int, Limit], motion: Array, noise: Array) -> Tolerance:
    """Return the tolerance of every degree of freedom: as given, else the larger of NOISES sd and SHARE of the motion.

    Of what turns, SHARE is of one turn at most: after it the joint is where it was.

    Args:
        given: {degree of freedom: limit}.
        motion, noise: `[nv]`, range of motion and standard deviation of the noise, rad or m.
    """
    units = tuple(length_unit(model, v) for v in range(model.nv))
    most = np.where(np.array(units) == "rad", 2 * np.pi, np.inf)
    limit = np.maximum(NOISES * noise, SHARE * np.minimum(motion, most))
    for dof, own in given.items():
        limit[dof] = own.value * motion[dof] if own.relative else own.value
    user = np.isin(np.arange(model.nv), list(given))
    return Tolerance(Channels.of(model).qvel, units, limit, np.asarray(motion, float), np.asarray(noise, float), user)
