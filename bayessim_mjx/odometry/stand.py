"""Inertial measurement units of a robot whose base does not float: how the stand leans and shakes."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np

from bayessim_mjx.errors import UserError
from bayessim_mjx.logs.log import Array, Log
from bayessim_mjx.odometry import imu
from bayessim_mjx.odometry.smoother import Noise

HOLDS = 1e-4  # m and rad, of a weld to the world: below every sensor's noise; a rule of thumb
WELD = int(mujoco.mjtEq.mjEQ_WELD)


@dataclass(frozen=True, eq=False)
class Stand:
    """What the units of one log say of a fixed base.

    Attributes:
        sensors: their names, of those on the fixed base; others: of those on moving bodies.
        unplaced: why columns belong to no sensor of the model; "": they do.
        lean: rad, angle between the model's vertical and the accelerometer's mean; NaN: there is none.
        sd_lean: rad, by the bias that is usual of accelerometers (`Noise.accel_bias`).
        shake: rad/s, root mean square of the gyroscope beside its mean and its noise; NaN: there is none.
    """

    sensors: tuple[str, ...]
    others: tuple[str, ...]
    lean: float
    sd_lean: float
    shake: float
    unplaced: str = ""


def measure(log: Log, model: mujoco.MjModel) -> Stand | None:
    """Return what the log's units say of a fixed base, and which are on other bodies; None: it has none."""
    if not any((found := imu.column(name)) is not None and found[0] != "touch" for name in log.streams):
        return None
    try:
        every = [s for s in imu.sensors(log, model) if s.kind != "touch"]
    except UserError as error:
        return Stand((), (), np.nan, np.nan, np.nan, str(error))
    fixed = [s for s in every if s.body == 0]
    others = tuple(s.label for s in every if s.body != 0)
    lean, sd, shake = np.nan, np.nan, np.nan
    for sensor in fixed:
        mean = np.nanmean(sensor.values(log), axis=0) @ sensor.turn.T
        if sensor.kind == "accel":
            up = -np.asarray(model.opt.gravity, float)
            lean = float(np.arctan2(np.linalg.norm(np.cross(mean, up)), mean @ up))
            sd = Noise.accel_bias / max(float(np.linalg.norm(up)), 1e-9)
        if sensor.kind == "gyro":
            spread, noise = np.nanvar(sensor.values(log), axis=0), sensor.noise(log) ** 2
            shake = float(np.sqrt(max(np.sum(spread - noise), 0.0)))
    return Stand(tuple(s.label for s in fixed), others, lean, sd, shake)


def welded(model: mujoco.MjModel, body: int) -> Array | None:
    """Return the pose `[7]` in which a weld to the world holds a body; None: no weld does."""
    for i in np.flatnonzero((model.eq_type == WELD) & (model.eq_active0 > 0)):
        pair = int(model.eq_obj1id[i]), int(model.eq_obj2id[i])
        if int(model.eq_objtype[i]) == int(mujoco.mjtObj.mjOBJ_BODY) and sorted(pair) == [0, body]:
            data = model.eq_data[i]
            place, turn = np.array(data[3:6]), np.array(data[6:10])
            if pair[0] == body:  # of the world from the body
                mujoco.mju_negPose(place, turn, data[3:6].copy(), data[6:10].copy())
            return np.concatenate([place, turn])
    return None
