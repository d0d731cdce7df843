"""Columns of an inertial measurement unit in a log, and the sensors of the model that they belong to."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray

from bayessim_mjx.errors import UserError
from bayessim_mjx.logs.inertial import MEAN, SIZES, column
from bayessim_mjx.logs.log import Array, Log, suggest
from bayessim_mjx.logs.signals import noise_level

# the model's type of sensor of each kind of column
KINDS = {
    "gyro": mujoco.mjtSensor.mjSENS_GYRO,
    "accel": mujoco.mjtSensor.mjSENS_ACCELEROMETER,
    "quat": mujoco.mjtSensor.mjSENS_FRAMEQUAT,
    "touch": mujoco.mjtSensor.mjSENS_TOUCH,
}
_SITE, _XBODY = int(mujoco.mjtObj.mjOBJ_SITE), int(mujoco.mjtObj.mjOBJ_XBODY)


@dataclass(frozen=True, eq=False)
class Sensor:
    """One sensor of the log, as it is mounted in the model.

    Attributes:
        kind: gyro, accel, quat or touch; name: behind the colon of its columns, "" without one.
        columns: of the log, in order; body: that carries it.
        place: `[3]` m, from the frame of the rigid body it is part of; turn: `[3, 3]`, its frame to that one.
    """

    kind: str
    name: str
    columns: tuple[str, ...]
    body: int
    place: Array
    turn: Array

    @property
    def label(self) -> str:
        return f"{self.kind}:{self.name}" if self.name else self.kind

    def values(self, log: Log, mean: bool = False) -> Array:
        """`[T, n]` at the log's rows; between samples linear, NaN where there is none.

        mean: over the time around each row, where the file has more samples than rows.
        """
        late = float(log.metadata.get("imu_late", 0.0)) if self.kind != "touch" else 0.0
        names = [MEAN + c if mean and MEAN + c in log.streams else c for c in self.columns]
        return np.stack([_at(log.time + late, log.time, log.streams[c]) for c in names], 1)

    def noise(self, log: Log) -> Array:
        """Return standard deviations `[n]` of the noise that the samples show, or that `sigma` of the log states."""
        stated = log.metadata.get("sigma") or {}
        levels = []
        for name in self.columns:
            x = log.streams[name]
            own = stated.get(name, stated.get(self.label))
            levels.append(noise_level(x[np.isfinite(x)]) if own is None else float(own))
        return np.array(levels)

    def rate(self, log: Log) -> float:
        """Return the samples per second."""
        count = int(np.isfinite(log.streams[self.columns[0]]).sum())
        return (count - 1) / log.duration if log.duration > 0 else 0.0


def _at(wanted: Array, time: Array, x: Array) -> Array:
    seen = np.isfinite(x)
    return np.interp(wanted, time[seen], x[seen]) if seen.any() else np.full(len(wanted), np.nan)


def sensors(log: Log, model: mujoco.MjModel) -> tuple[Sensor, ...]:
    """Return the sensors that the log has columns of.

    Raises:
        UserError: a column names none of the model's sensors, or lacks some of its numbers.
    """
    return of_columns(log.streams, model, str(log.metadata.get("source", log.name)))


def of_columns(names: Iterable[str], model: mujoco.MjModel, source: str) -> tuple[Sensor, ...]:
    """`sensors` of columns with these names; source: for messages."""
    found: dict[tuple[str, str], dict[int, str]] = {}
    for name in names:
        parts = column(name)
        if parts is not None:
            found.setdefault(parts[:2], {})[parts[2]] = name
    mounted = _mounted(model) if found else {}
    return tuple(_sensor(kind, name, own, model, mounted, source) for (kind, name), own in sorted(found.items()))


def _sensor(
    kind: str,
    name: str,
    own: Mapping[int, str],
    model: mujoco.MjModel,
    mounted: Mapping[str, Mapping[str, tuple[int, int]]],
    source: str,
) -> Sensor:
    label, count = f"{kind}:{name}" if name else kind, SIZES[kind]
    if sorted(own) != list(range(count)):
        wanted = ", ".join(f"{label}[{i}]" if count > 1 else label for i in range(count))
        raise UserError(f"{source}: columns {', '.join(own.values())} of {label}; allowed: all of {wanted}")
    here = mounted[kind]
    if name and name not in here:
        raise UserError(f"{source}: column {own[0]!r}: {_no_sensor(kind)}; {suggest(name, here)}")
    places = {here[name]} if name else set(here.values())
    if len(places) != 1:
        say = f"the model has {len(places) or 'no'} places of a sensor {_tag(kind)}"
        way = f"{kind}:NAME names one of {', '.join(here)}" if here else f"add <{_tag(kind)} site=.../> to the model"
        raise UserError(f"{source}: column {own[0]!r} names no sensor, and {say}; {way}")
    (place,) = places
    return Sensor(kind, name, tuple(own[i] for i in range(count)), *_frame(model, *place))


def _tag(kind: str) -> str:
    """MJCF element of the sensor."""
    return KINDS[kind].name.removeprefix("mjSENS_").lower()


def _no_sensor(kind: str) -> str:
    return f"the model has no sensor {_tag(kind)} and no site of this name"


def _mounted(model: mujoco.MjModel) -> dict[str, dict[str, tuple[int, int]]]:
    """{kind: {name of a sensor or of a site: (object type, its id)}}; sites named imu stand in for missing sensors."""
    out: dict[str, dict[str, tuple[int, int]]] = {}
    sites = {model.site(i).name: (_SITE, i) for i in range(model.nsite) if model.site(i).name}
    for kind, sort in KINDS.items():
        own = [i for i in range(model.nsensor) if int(model.sensor_type[i]) == int(sort)]
        places = [(int(model.sensor_objtype[i]), int(model.sensor_objid[i])) for i in own]
        named = {model.sensor(i).name or f"sensor{i}": place for i, place in zip(own, places, strict=True)}
        free = sites if kind == "touch" else {n: place for n, place in sites.items() if "imu" in n.lower()}
        of_sites = {n: place for n, place in sites.items() if place in places} if own else free
        out[kind] = {**of_sites, **named}
    return out


def _frame(model: mujoco.MjModel, sort: int, i: int) -> tuple[int, Array, Array]:
    """(body, place `[3]`, turn `[3, 3]`) in the frame of the first body of those that are rigidly joined."""
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    if sort == _SITE:
        body, place, turn = int(model.site_bodyid[i]), data.site_xpos[i], data.site_xmat[i]
    else:
        at = (data.xpos[i], data.xmat[i]) if sort == _XBODY else (data.xipos[i], data.ximat[i])
        body, place, turn = i, *at
    rigid = int(model.body_weldid[body])
    frame = data.xmat[rigid].reshape(3, 3)
    return rigid, frame.T @ (place - data.xpos[rigid]), frame.T @ turn.reshape(3, 3)


def rotation(quat: Array) -> NDArray[np.float64]:
    """Rotation matrix `[3, 3]` of a quaternion `[4]`: body to world."""
    out = np.empty(9)
    mujoco.mju_quat2Mat(out, quat)
    return out.reshape(3, 3)
