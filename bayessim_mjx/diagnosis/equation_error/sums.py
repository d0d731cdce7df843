"""All logs as sums of products of columns and efforts: what follows is algebra on small matrices."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import mujoco
import numpy as np
from numpy.typing import NDArray

from bayessim_mjx import effects as library
from bayessim_mjx.diagnosis.logcheck import drives, rigid_body
from bayessim_mjx.diagnosis.logcheck.regressor import FEWEST, Mask, Regressor, motion
from bayessim_mjx.effects.support.actuators import OfGains
from bayessim_mjx.logs.log import Log

Array = NDArray[np.float64]
OWN = ("acceleration", "speed", "dry", "drag", "position", "one", "load", "effort_load")
# multiples of a servo's gain at which its effort is computed; between them it is interpolated. A rule of thumb
GAINS = (0.1, 0.32, 1.0, 3.2, 10.0)
ROWS = 12000  # of all logs together, at their own rates: seconds, not errors; a choice, not counted


@dataclass(frozen=True)
class Layout:
    """Where the columns stand: ten of each body, the joint's own (OWN), zeros `[nv]`, drives, tilt [2], and others.

    shared: actuators that drive a joint together with others; each has a column of its own effort.
    gains: (effect, actuator) of gains of servos and declared controllers; each has columns of what
        the effort gains with each of GAINS.
    laden: loads on the bodies have ten columns of their own: what carries a body's weight (`gravcomp`) carries no load.
    """

    bodies: int
    nv: int
    shared: tuple[int, ...] = ()
    gains: tuple[tuple[str, int], ...] = ()
    laden: bool = False

    @cached_property
    def _starts(self) -> dict[str, int]:
        inertial = rigid_body.INERTIAL * self.bodies
        kinds = {"body": inertial, "laden": inertial * self.laden} | dict.fromkeys(OWN, 1)
        kinds |= {
            "zero": self.nv,
            "drive": len(self.shared),
            "gain": len(GAINS) * len(self.gains),
            "tilt": 2,
            "late": 1,
            "known": 1,
            "effort": 1,
            "end": 0,
        }
        return dict(zip(kinds, np.cumsum([0, *kinds.values()]).tolist(), strict=False))

    @property
    def size(self) -> int:
        return self.at("end")

    def at(self, kind: str) -> int:
        """Return the (first) column of one of OWN, or of zero, tilt, late, known (what the model says) and effort."""
        return self._starts[kind]

    def body(self, i: int) -> slice:
        return slice(rigid_body.INERTIAL * i, rigid_body.INERTIAL * (i + 1))

    def load(self, i: int) -> slice:
        """Of a load on a body."""
        start = self.at("laden") if self.laden else 0
        return slice(start + rigid_body.INERTIAL * i, start + rigid_body.INERTIAL * (i + 1))

    def drive(self, actuator: int) -> int:
        """Of one of the actuators `shared`."""
        return self.at("drive") + self.shared.index(actuator)

    def gain(self, effect: str, actuator: int) -> int:
        """Return the first column of one of the `gains`."""
        return self.at("gain") + len(GAINS) * self.gains.index((effect, actuator))


@dataclass(frozen=True, eq=False)
class Sums:
    """Products of the columns, each row counted as so many independent ones.

    Attributes:
        gram: `[nv, P, P]`; rows: `[nv]`, independent rows.
        source: `[nv]`, where the effort comes from (`drives.sources`).
        period: s between the logs' rows.
    """

    layout: Layout
    gram: Array
    rows: Array
    source: tuple[str, ...]
    period: float

    @cached_property
    def used(self) -> Mask:
        """`[nv]`: joints whose effort is known and that moved."""
        known = np.array([s != "" for s in self.source])
        return np.asarray(known & (self.rows >= FEWEST) & (self.size > 0))

    def power(self, column: int) -> Array:
        """`[nv]`, mean square of a column."""
        return np.asarray(self.gram[:, column, column] / np.maximum(self.rows, 1e-9))

    @cached_property
    def size(self) -> Array:
        """`[nv]`, rms of the effort, measured or needed; where nothing drives a joint, of what acts on it."""
        lay = self.layout
        return np.sqrt(np.max([self.power(c) for c in (lay.at("effort"), lay.at("known"), lay.at("load"))], axis=0))


def layout_of(model: mujoco.MjModel, bodies: int, loops: Mapping[str, NDArray[np.bool_]]) -> Layout:
    """Return the columns of a model with so many moving bodies; loops: of declared controllers (`drives.loops_of`)."""
    dofs = [drives.dof_of(model, i) for i in range(model.nu)]
    shared = tuple(i for i, dof in enumerate(dofs) if dof is not None and dofs.count(dof) > 1)
    gains = [
        (kind.name, i)
        for kind in map(library.load, library.names())
        for i, dof in enumerate(dofs)
        if dof is not None
        and (loops[kind.loop][i] if kind.loop else issubclass(kind, OfGains) and kind.carries(model, i))
    ]
    return Layout(bodies, model.nv, shared, tuple(gains), bool(model.ngravcomp))


def columns(
    log: Log, model: mujoco.MjModel, layout: Layout, source: tuple[str, ...], slow: Array
) -> tuple[Array, Mask, float]:
    """(all columns of one log `[T, nv, size]`, rows `[nv, T]` to be used, how many independent ones a row is).

    Args:
        source: `[nv]`, see `drives.sources`; slow: `[nv]`, speeds at which dry friction turns over.
    """
    moved = motion(log, model)
    inertial = rigid_body.INERTIAL * layout.bodies * layout.laden
    twice = np.tile(np.eye(inertial).reshape(inertial, -1, rigid_body.INERTIAL), (2, 1, 1)) if layout.laden else None
    found = Regressor.of(model, moved, slow, twice, loads=inertial)
    x = np.zeros((len(moved.time), model.nv, layout.size))
    for v, column in rigid_body.by_zeros(model, moved.qpos, moved.qvel, moved.qacc).items():
        x[:, :, layout.at("zero") + v] = moved.smooth(column)
    x[:, :, : layout.at(OWN[0])] = found.columns
    x[:, :, [layout.at("tilt"), layout.at("tilt") + 1]], x[:, :, layout.at("known")] = found.tilt, found.known
    of = {"effort": drives.measured_forces(log, model), "ctrl": drives.commanded(drives.centred(log), model)}
    each = {name: drives.on_dofs(force, model) for name, force in of.items()}
    effort = np.where(np.array(source) == "effort", each["effort"], each["ctrl"])
    y = np.stack([moved.filtered(effort[:, v], log) for v in range(model.nv)], 1)
    for name, column in found.own.items():
        x[:, :, layout.at(name)] = column
    x[:, :, layout.at("effort_load")] = moved.smooth(np.abs(y) * found.dry)
    factors = [factor if factor != 1.0 else 1.0 + rigid_body.SHIFT for factor in GAINS]  # a derivative at 1
    for k, (name, i) in enumerate(layout.gains):
        dof = drives.dof_of(model, i)
        if dof is not None and source[dof] == "ctrl":  # a measured effort is what the servo gave, whatever its gains
            for g, more in enumerate(
                drives.by_gain(log, model, library.load(name), i, of["ctrl"][:, i], factors), len(GAINS) * k
            ):
                x[:, dof, layout.at("gain") + g] = moved.filtered(model.actuator_gear[i, 0] * more, log)
    x[:, :, layout.at("effort")], x[:, :, layout.at("late")] = y, np.gradient(y, moved.step, axis=0)
    for i in layout.shared:
        dof = drives.dof_of(model, i)
        if dof is not None and source[dof] in of:
            x[:, dof, layout.drive(i)] = moved.filtered(model.actuator_gear[i, 0] * of[source[dof]][:, i], log)
    rows = np.stack([moved.moving(v) & (source[v] != "") for v in range(model.nv)])
    return x, rows, moved.share


def gather(logs: Sequence[Log], model: mujoco.MjModel) -> Sums:
    """Return the sums of logs that move; joints whose effort is not known in all of them are left out."""
    source, loops = drives.sources(logs, model), drives.loops_of(model, logs)
    layout = layout_of(model, len(rigid_body.moving_bodies(model)), loops)
    short = shortened(logs)
    top = np.max([np.percentile(np.abs(log.qvel), 95, axis=0) for log in short], axis=0)
    gram, rows = np.zeros((model.nv, layout.size, layout.size)), np.zeros(model.nv)
    for log in short:
        x, moving, share = columns(log, model, layout, source, drives.LEAST * top + 1e-12)
        for v in range(model.nv):
            own = x[moving[v], v]
            gram[v] += share * own.T @ own
            rows[v] += share * len(own)
    return Sums(layout, gram, rows, source, float(np.median([log.period for log in logs])))


def shortened(logs: Sequence[Log]) -> list[Log]:
    """Keep the middle parts of logs that are too long together."""
    share = ROWS / max(sum(len(log) for log in logs), 1)
    if share >= 1:
        return list(logs)
    spans = [(len(log), max(int(share * len(log)), min(len(log), 200))) for log in logs]
    return [log.cut((n - k) // 2, (n + k) // 2) for log, (n, k) in zip(logs, spans, strict=True)]
