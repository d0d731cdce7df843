"""The pose and velocity of a floating base that nobody measured, estimated from a log; and logs completed by them."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np

from bayessim_mjx.errors import UserError
from bayessim_mjx.logs.inertial import NAMES, having
from bayessim_mjx.logs.log import Array, Log
from bayessim_mjx.logs.signals import derivative
from bayessim_mjx.odometry import feet, imu, smoother, stand
from bayessim_mjx.odometry.imu import Sensor
from bayessim_mjx.odometry.smoother import Inputs, Noise, Track

# of the accelerometer's noise that its samples show: vibration and shocks between samples add to it. The most likely
# one is taken. Rules of thumb, not counted
ROUGH = (1.0, 3.0, 10.0, 30.0)
ROWS = 300  # of a log, that choose it: a choice between seconds and accuracy, not counted
LEAST = (
    1e-4,
    5e-3,
)  # rad/s and m/s^2, noise of a gyroscope and an accelerometer at least: good sensors; rules of thumb
SETTLED = 0.2  # s at a log's begin, over which the first vertical is averaged; a rule of thumb


@dataclass(frozen=True, eq=False)
class Base:
    """The motion of a floating base, in the world, by one log.

    Attributes:
        qpos: `[T, 7]`, qvel: `[T, 6]`, of the free joint, as MuJoCo has them.
        sd_qpos: `[T, 6]` m and rad, standard deviations in the tangent space; infinite for x and y, which nothing
            measures. Of the three rotations those of the tilt: nothing measures the heading.
        sd_qvel: `[T, 6]`, of velocity in the world and rate in the base's frame.
        heading: whether the heading was measured: always False.
        gyro_bias, accel_bias: `[3]`, at the middle of the log; sd_gyro_bias, sd_accel_bias: `[3]`.
        points: that may touch the ground; sensors: that were used.
        covariance: `[T, 6, 6]`, of position and orientation; x, y and heading are those since the first row.
        noise: rad/s, of the gyroscope's samples `[3]` in the base's frame.
    """

    qpos: Array
    qvel: Array
    sd_qpos: Array
    sd_qvel: Array
    gyro_bias: Array
    sd_gyro_bias: Array
    accel_bias: Array
    sd_accel_bias: Array
    points: feet.Feet
    covariance: Array
    sensors: tuple[Sensor, ...]
    noise: Array
    heading: bool = False


def estimate(log: Log, model: mujoco.MjModel) -> Base:
    """Return the base's motion by gyroscope, accelerometer, orientation where given, encoders and feet.

    Raises:
        UserError: no free joint, a sensor is missing or sits elsewhere, or there is no level ground.
    """
    joint = feet.base_joint(model)
    if joint < 0:
        raise UserError(f"{log.name}: the model has no single free joint, so there is no floating base to estimate")
    own = _on_base(log, model, joint)
    gyro, accel = own["gyro"], own["accel"]
    rate = gyro.values(log, mean=True) @ gyro.turn.T
    force = _at_base(log, rate, accel.values(log, mean=True) @ accel.turn.T, accel.place)
    vertical, attitude = _verticals(log, own.get("quat"), force)
    every = tuple(own.values()) + tuple(s for s in imu.sensors(log, model) if s.kind == "touch")
    levels = [max(float(np.median(s.noise(log))), least) for s, least in zip((gyro, accel), LEAST, strict=True)]
    gravity = float(np.linalg.norm(model.opt.gravity))
    per_second = own["quat"].rate(log) if "quat" in own else 0.0

    def inputs(attitude: Array, height: Array | None) -> Inputs:
        points = feet.measured(model, log, attitude, force, every, height)
        _demand_rest(log, points)
        return Inputs(log.time, rate, force, vertical, per_second, gravity, points)

    first = inputs(attitude, None)
    rough = [Noise(levels[0], levels[1] * times) for times in ROUGH]
    noise = smoother.likeliest(first.cut(ROWS), rough, attitude[0])
    track = smoother.smooth(first, noise, attitude[0])
    second = inputs(track.attitude, track.position[:, 2])
    track = smoother.smooth(second, noise, track.attitude[0])
    found = _base(track, second, every, np.abs(gyro.turn) @ gyro.noise(log))
    sampled = gyro.values(log) @ gyro.turn.T - track.gyro_bias  # not its mean: so it is compared
    return dataclasses.replace(found, qvel=np.concatenate([found.qvel[:, :3], sampled], 1))


def _on_base(log: Log, model: mujoco.MjModel, joint: int) -> dict[str, Sensor]:
    """{kind: sensor} of those on the base.

    Raises:
        UserError: gyroscope or accelerometer is missing, or two of a kind are there.
    """
    body, source = int(model.jnt_bodyid[joint]), str(log.metadata.get("source", log.name))
    own: dict[str, Sensor] = {}
    for sensor in imu.sensors(log, model):
        if sensor.kind != "touch" and sensor.body == body:
            if sensor.kind in own:
                raise UserError(
                    f"{source}: {own[sensor.kind].label} and {sensor.label} are both on the base; allowed: one"
                )
            own[sensor.kind] = sensor
    missing = [NAMES[kind] for kind in ("gyro", "accel") if kind not in own]
    if missing:
        name, given = log.joints[joint], ", ".join(s.label for s in own.values()) or "none"
        raise UserError(
            f"{source}: free joint {name!r} was not measured, and there is no {' and no '.join(missing)} on body "
            f"{model.body(body).name!r} (its sensors in the log: {given}); allowed: columns gyro:SENSOR[0..2] and "
            f"accel:SENSOR[0..2], or qpos:{name}[0..6]"
        )
    return own


def _demand_rest(log: Log, points: feet.Feet) -> None:
    share = float(points.rests.any(axis=1).mean())
    if share == 0.0:
        raise UserError(
            f"{log.name}: no point of the robot rests on the ground ({', '.join(points.names)}): the base's velocity "
            "is unknown; allowed: logs of a robot that stands, or with the base's pose"
        )


def _at_base(log: Log, rate: Array, force: Array, place: Array) -> Array:
    """Specific force at the base's origin, from that at `place` `[3]`: less what the rotation adds there."""
    if not place.any():
        return force
    spread = [float(np.std(np.diff(x, 4)) / np.sqrt(70.0)) for x in rate.T]  # of white noise: `signals.noise_level`
    turned = np.stack([derivative(log.time, x, s)[0] for x, s in zip(rate.T, spread, strict=True)], 1)
    return np.asarray(force - np.cross(turned, place) - np.cross(rate, np.cross(rate, place)))


def _verticals(log: Log, quat: Sensor | None, force: Array) -> tuple[Array | None, Array]:
    """(directions against gravity `[T, 3]` by an orientation sensor or None, guesses of the attitude `[T, 4]`)."""
    if quat is not None:
        turn = np.empty(4)
        mujoco.mju_mat2Quat(turn, quat.turn.T.reshape(-1))
        attitude = np.empty((len(log), 4))
        for row, own in zip(attitude, _unit(log, quat), strict=True):
            mujoco.mju_mulQuat(row, own, turn)
        return np.stack([imu.rotation(q)[2] for q in attitude]), attitude
    rows = max(1, round(SETTLED / log.period))
    padded = np.pad(force, ((rows, rows), (0, 0)), mode="edge")
    mean = np.stack([np.convolve(x, np.full(2 * rows + 1, 1.0), mode="valid") for x in padded.T], 1)
    return None, np.stack([_upright(m) for m in mean])


def _unit(log: Log, quat: Sensor) -> Array:
    """Quaternions `[T, 4]` of norm 1.

    Raises:
        UserError: they are none.
    """
    raw = np.stack([log.streams[c] for c in quat.columns], 1)
    seen = np.isfinite(raw).all(axis=1)
    norm = np.linalg.norm(raw[seen], axis=1)
    if not len(norm) or np.abs(norm - 1.0).max() > 0.05:  # of a sensor of single digits; a rule of thumb
        raise UserError(f"{log.name}: {quat.label} has norm {norm.max(initial=0.0):.3g}; allowed: 1, as w, x, y, z")
    values = quat.values(log)
    return np.asarray(values / np.linalg.norm(values, axis=1, keepdims=True))


def _upright(force: Array) -> Array:
    """Return the quaternion `[4]` without a heading of a body at rest, by its specific force `[3]`."""
    up = force / np.linalg.norm(force)
    axis = np.cross(up, [0.0, 0.0, 1.0])
    out = np.concatenate([[1.0 + up[2]], axis])
    size = float(np.linalg.norm(out))
    return out / size if size > 1e-9 else np.array([0.0, 1.0, 0.0, 0.0])


def _base(track: Track, inputs: Inputs, sensors: Sequence[Sensor], noise: Array) -> Base:
    sd = np.sqrt(np.maximum(np.diagonal(track.covariance, axis1=1, axis2=2), 0.0))
    up = np.stack([imu.rotation(q)[2] for q in track.attitude])
    level = np.eye(3) - np.einsum("ti,tj->tij", up, up)  # without the turn about the vertical
    tilt = np.einsum("tij,tjk,tik->t", level, track.covariance[:, smoother.R, smoother.R], level) / 2
    middle = len(track.position) // 2
    turned = np.repeat(np.sqrt(np.maximum(tilt, 0.0))[:, None], 3, axis=1)
    moved = np.stack([np.full(len(sd), np.inf), np.full(len(sd), np.inf), sd[:, 2]], 1)
    return Base(
        qpos=np.concatenate([track.position, track.attitude], 1),
        qvel=np.concatenate([track.velocity, track.rate], 1),
        sd_qpos=np.concatenate([moved, turned], 1),
        sd_qvel=np.concatenate([sd[:, smoother.V], sd[:, smoother.BG]], 1),
        gyro_bias=track.gyro_bias[middle],
        sd_gyro_bias=sd[middle, smoother.BG],
        accel_bias=track.accel_bias[middle],
        sd_accel_bias=sd[middle, smoother.BA],
        points=inputs.feet,
        covariance=track.covariance[:, :6, :6],
        sensors=tuple(sensors),
        noise=noise,
    )


def of_logs(logs: Sequence[Log], model: mujoco.MjModel) -> list[tuple[Log, Base | None]]:
    """Return each log completed by the motion of a floating base that shows in a gyroscope; empty: there is none."""
    if not any(having(log.streams, "gyro") and feet.lost_base(log, model) for log in logs):
        return []
    return [completed(log, model) if log.lost else (log, None) for log in logs]


def completed(log: Log, model: mujoco.MjModel) -> tuple[Log, Base | None]:
    """Return the log with the base's motion: its rates as measured by the gyroscope, the rest as guesses.

    Where a weld to the world holds the base there is no motion to estimate, and none is compared.

    Raises:
        UserError: see `estimate`; or another joint was not measured.
    """
    name = feet.lost_base(log, model)
    others = [c for c in log.lost if c not in {f"qpos:{n}" for n in log.channels.of_joint(name)}]
    if others:
        raise UserError(
            f"{log.name}: {', '.join(others)} were not measured, and neither was the floating base {name!r}; allowed: "
            "logs with the positions of all joints, or of the base"
        )
    held = stand.welded(model, int(model.jnt_bodyid[log.joints.index(name)]))
    if held is not None:
        pose, twist = np.tile(held, (len(log), 1)), np.zeros((len(log), 6))
        return _with(log, name, (pose, np.full(7, stand.HOLDS)), (twist, np.full(6, stand.HOLDS)), rates=False), None
    base = estimate(log, model)
    posture = np.array(log.qpos[0])
    posture[log.channels.columns(name)] = base.qpos[0]
    deep = stand.depth(model, posture)
    pose, spread = stand.settled(base.qpos, base.covariance, base.points, deep)
    sd = np.sqrt(np.median(np.diagonal(spread, axis1=1, axis2=2), axis=0))
    tilt = float(np.sqrt(np.mean(sd[3:5] ** 2)))  # the heading's is that of the tilt: nothing depends on either
    # as `Log.sigma_dofs` reads it; nothing depends on x and y either
    sigma = np.concatenate([np.full(3, sd[2]), np.full(4, tilt * np.sqrt(3) / 4)])
    speed = np.sqrt(np.median(base.sd_qvel**2, axis=0))
    speed[3:] = np.hypot(base.noise, speed[3:])
    return _with(log, name, (pose, sigma), (base.qvel, speed), rates=True), base


def _with(log: Log, name: str, pose: tuple[Array, Array], twist: tuple[Array, Array], rates: bool) -> Log:
    """Return the log with values and standard deviations of the free joint; rates: its rotation counts as measured."""
    q, v = log.channels.columns(name), log.channels.columns(name, "qvel")
    qpos, sigma_qpos, qvel, sigma_qvel = (np.array(x) for x in (log.qpos, log.sigma_qpos, log.qvel, log.sigma_qvel))
    qpos[:, q], sigma_qpos[q] = pose
    qvel[:, v], sigma_qvel[v] = twist
    unknown = [] if log.has_qvel else [f"qvel:{n}" for n in log.channels.qvel]
    seen = {f"qvel:{n}" for n in log.channels.qvel[v][3:]} if rates else set()
    absent = [n for n in dict.fromkeys((*log.absent, *unknown)) if n not in seen]
    none = not rates and not log.has_qvel
    return dataclasses.replace(
        log,
        qpos=qpos,
        qvel=qvel,
        has_qvel=not none,
        absent=tuple(n for n in absent if not (none and n.startswith("qvel:"))),
        sigma_qpos=sigma_qpos,
        sigma_qvel=sigma_qvel,
    )
