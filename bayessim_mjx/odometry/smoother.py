"""An extended Kalman filter and smoother for the motion of a floating base over resting feet.

The state is position, orientation and velocity of the base, both biases of the inertial measurement unit and the
resting points. The unit drives it; each resting point is seen from the base by the encoders (Bloesch et al., State
Estimation for Legged Robots, 2012); the smoother is that of Rauch, Tung and Striebel (1965). Position over the ground
and heading are fixed at the first row: nothing measures them.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray

from bayessim_mjx.logs.log import Array
from bayessim_mjx.odometry.feet import Feet
from bayessim_mjx.odometry.imu import rotation

P, R, V, BG, BA, C = (slice(3 * i, 3 * i + 3) for i in range(6))  # the state's parts; from C on resting points
SIZE = C.start
# m and rad, of what nothing measures, at the first row: a choice of the origin, no knowledge. A rule of thumb: smaller
# ones cost float64 digits
FIXED = 1e-4
FREE = 1.0  # m, of a point over the ground before it was seen: as good as unknown; a rule of thumb
OUTLIER = (
    16.27  # squared error of a point from which it slipped: of three Gaussian numbers 1 in 1000 exceed it; float64
)


@dataclass(frozen=True)
class Noise:
    """Standard deviations, rules of thumb, not counted, but for those of the two sensors' samples.

    Attributes:
        gyro, accel: of the samples, rad/s and m/s^2.
        gyro_bias, accel_bias: at the first row; gyro_walk, accel_walk: of their random walks in 1 s.
        sinks: m, of a point's height above or below the ground: soft ground, a wrong length of a leg.
        slips: m in 1 s, a random walk of a resting point; seen: m, of a point from the base beside the encoders' noise.
        start: m/s, of the first velocity; tilt: rad, of an orientation sensor's vertical, averaged over 1 s.
        leans: rad, of the first tilt.
    """

    gyro: float
    accel: float
    gyro_bias: float = 0.05
    accel_bias: float = 0.3
    gyro_walk: float = 1e-4
    accel_walk: float = 1e-3
    sinks: float = 2e-3
    slips: float = 2e-3
    seen: float = 3e-4
    start: float = 0.5
    tilt: float = 0.0175
    leans: float = 0.1


@dataclass(frozen=True, eq=False)
class Inputs:
    """Measurements in the base's frame.

    Attributes:
        time: `[T]` s; rate: `[T, 3]` rad/s; force: `[T, 3]` m/s^2, specific force at the base.
        vertical: `[T, 3]`, direction against gravity by an orientation sensor, or None; per_second: its samples in 1 s.
        gravity: m/s^2; feet: resting points.
    """

    time: Array
    rate: Array
    force: Array
    vertical: Array | None
    per_second: float
    gravity: float
    feet: Feet

    def cut(self, rows: int) -> Inputs:
        """Return the first rows."""
        own, feet = slice(0, rows), self.feet
        points = {name: getattr(feet, name)[own] for name in ("point", "spread", "rolled", "rests")}
        given = {name: getattr(self, name)[own] for name in ("time", "rate", "force")}
        vertical = None if self.vertical is None else self.vertical[own]
        return dataclasses.replace(self, **given, vertical=vertical, feet=dataclasses.replace(feet, **points))


@dataclass(frozen=True, eq=False)
class Track:
    """A smoothed motion.

    Attributes:
        position, velocity: `[T, 3]` m, m/s, in the world; attitude: `[T, 4]`, quaternions; rate: `[T, 3]` rad/s.
        gyro_bias, accel_bias: `[T, 3]`.
        covariance: `[T, 15, 15]`, of position, orientation (in the base's frame), velocity and both biases.
        likelihood: logarithm of the density of what was measured.
    """

    position: Array
    attitude: Array
    velocity: Array
    rate: Array
    gyro_bias: Array
    accel_bias: Array
    covariance: Array
    likelihood: float


@dataclass
class _State:
    """x: vector without the orientation, whose place in it stays 0; quat: orientation."""

    x: Array
    quat: Array

    def moved(self, change: Array) -> _State:
        x, quat = self.x + change, self.quat.copy()
        x[R] = 0.0
        mujoco.mju_quatIntegrate(quat, change[R], 1.0)
        return _State(x, quat)

    def minus(self, other: _State) -> Array:
        out = self.x - other.x
        mujoco.mju_subQuat(out[R], self.quat, other.quat)
        return out


def cross(v: Array) -> Array:
    """Matrix `[3, 3]` of the product v x."""
    return np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])


def smooth(inputs: Inputs, noise: Noise, quat: Array) -> Track:
    """Return the motion along a log. quat: `[4]`, the first orientation."""
    return _Filter(inputs, noise, quat).back()


class _Filter:
    """The filter along one log, and what its smoother needs."""

    def __init__(self, inputs: Inputs, noise: Noise, quat: Array) -> None:
        self.inputs, self.noise, self.feet = inputs, noise, inputs.feet
        self.n = SIZE + 3 * len(self.feet.names)
        self.likelihood = 0.0
        state, spread = self._start(quat)
        lost = np.zeros(len(self.feet.names), bool)
        self.kept: list[tuple[_State, Array]] = []
        self.predicted: list[tuple[_State, Array]] = []
        self.ways: list[Array] = []
        for k in range(len(inputs.time)):
            if k:
                anew = self.feet.rests[k] & (~self.feet.rests[k - 1] | lost)
                state, spread = self._predicted(state, spread, k, anew)
            state, spread, lost = self._corrected(state, spread, k)
            self.kept.append((state, spread))

    def _start(self, quat: Array) -> tuple[_State, Array]:
        noise, feet = self.noise, self.feet
        turn, x = rotation(quat), np.zeros(self.n)
        heights = (feet.point[0] @ turn.T)[:, 2]
        own = feet.rests[0] if feet.rests[0].any() else heights <= heights.min()
        x[2] = feet.ground - float(np.mean(heights[own]))
        spread = np.zeros((self.n, self.n))
        spread[P, P] = np.diag([FIXED, FIXED, FREE]) ** 2
        spread[R, R] = turn.T @ np.diag([noise.leans**2, noise.leans**2, FIXED**2]) @ turn
        spread[V, V] = noise.start**2 * np.eye(3)
        spread[BG, BG], spread[BA, BA] = noise.gyro_bias**2 * np.eye(3), noise.accel_bias**2 * np.eye(3)
        state = _State(x, np.array(quat, float))
        for i in range(len(feet.names)):
            self._anew(state, spread, 0, i)
        return state, spread

    def _anew(self, state: _State, spread: Array, k: int, i: int) -> None:
        """Forget where point i rests, in place: anywhere on the ground."""
        own = slice(SIZE + 3 * i, SIZE + 3 * i + 3)
        place = state.x[P] + rotation(state.quat) @ self.feet.point[k, i]
        state.x[own] = place[0], place[1], self.feet.ground
        spread[own, :], spread[:, own] = 0.0, 0.0
        spread[own, own] = np.diag([FREE**2, FREE**2, self.noise.sinks**2])

    def _predicted(self, state: _State, spread: Array, k: int, anew: NDArray[np.bool_]) -> tuple[_State, Array]:
        """Return the state at row k; points that are `anew` may be anywhere on the ground."""
        given, noise = self.inputs, self.noise
        dt = float(given.time[k] - given.time[k - 1])
        rate = 0.5 * (given.rate[k] + given.rate[k - 1]) - state.x[BG]
        force = 0.5 * (given.force[k] + given.force[k - 1]) - state.x[BA]
        turn = rotation(state.quat)
        middle = state.quat.copy()
        mujoco.mju_quatIntegrate(middle, rate, dt / 2)
        mean = rotation(middle)
        gain = mean @ force - np.array([0.0, 0.0, given.gravity])
        new = _State(state.x.copy(), state.quat.copy())
        new.x[P] += dt * state.x[V] + 0.5 * dt**2 * gain
        new.x[V] += dt * gain
        mujoco.mju_quatIntegrate(new.quat, rate, dt)
        way, push = np.eye(self.n), np.zeros(self.n)
        way[P, V], way[P, R], way[P, BA] = dt * np.eye(3), -0.5 * dt**2 * mean @ cross(force), -0.5 * dt**2 * mean
        way[V, R], way[V, BA] = -dt * mean @ cross(force), -dt * mean
        way[R, R], way[R, BG] = rotation(new.quat).T @ turn, -dt * np.eye(3)
        push[P], push[V], push[R] = 0.5 * dt**2 * noise.accel, dt * noise.accel, dt * noise.gyro
        push[BG], push[BA] = np.sqrt(dt) * noise.gyro_walk, np.sqrt(dt) * noise.accel_walk
        push[SIZE:] = np.sqrt(dt) * noise.slips
        for i in np.flatnonzero(self.feet.rests[k]):
            own = slice(SIZE + 3 * i, SIZE + 3 * i + 3)
            new.x[own] += rotation(new.quat) @ self.feet.rolled[k, i]
        fresh = np.zeros((self.n, self.n))
        for i in np.flatnonzero(anew):
            own = slice(SIZE + 3 * i, SIZE + 3 * i + 3)
            way[own], push[own] = 0.0, 0.0
            self._anew(new, fresh, k, int(i))
        spread = way @ spread @ way.T + np.diag(push**2) + fresh
        self.ways.append(way)
        self.predicted.append((new, spread))
        return new, spread

    def _corrected(self, state: _State, spread: Array, k: int) -> tuple[_State, Array, NDArray[np.bool_]]:
        """Return state and covariance with the measurements of a row, and the points that slipped."""
        feet, noise = self.feet, self.noise
        lost = np.zeros(len(feet.names), bool)
        for i in np.flatnonzero(feet.rests[k]):
            own, turn = slice(SIZE + 3 * i, SIZE + 3 * i + 3), rotation(state.quat)
            expected = turn.T @ (state.x[own] - state.x[P])
            seen = np.zeros((3, self.n))
            seen[:, P], seen[:, R], seen[:, own] = -turn.T, cross(expected), turn.T
            noisy = feet.spread[k, i] + noise.seen**2 * np.eye(3)
            state, spread, lost[i] = self._by(state, spread, seen, feet.point[k, i] - expected, noisy, OUTLIER)
        up = self.inputs.vertical
        if up is not None and np.isfinite(up[k]).all():
            expected = rotation(state.quat)[2]
            seen = np.zeros((3, self.n))
            seen[:, R] = cross(expected)
            noisy = noise.tilt**2 * max(self.inputs.per_second, 1.0) * np.eye(3)
            state, spread, _ = self._by(state, spread, seen, up[k] - expected, noisy, np.inf)
        return state, 0.5 * (spread + spread.T), lost

    def _by(
        self, state: _State, spread: Array, seen: Array, gap: Array, noisy: Array, most: float
    ) -> tuple[_State, Array, bool]:
        across = seen @ spread
        inner = across @ seen.T + noisy
        whole = np.linalg.solve(inner, np.column_stack([gap, across]))
        size = float(gap @ whole[:, 0])
        self.likelihood -= 0.5 * (min(size, most) + np.linalg.slogdet(inner)[1])
        if size > most:
            return state, spread, True
        return state.moved(across.T @ whole[:, 0]), spread - across.T @ whole[:, 1:], False

    def back(self) -> Track:
        """Return the smoothed motion: by all rows at each."""
        out = [self.kept[-1]]
        for k in range(len(self.ways) - 1, -1, -1):
            state, spread = self.kept[k]
            ahead, wide = self.predicted[k]
            gain = np.linalg.solve(wide, self.ways[k] @ spread).T
            known, narrow = out[-1]
            whole = spread + gain @ (narrow - wide) @ gain.T
            out.append((state.moved(gain @ known.minus(ahead)), 0.5 * (whole + whole.T)))
        states, spreads = zip(*reversed(out), strict=True)
        x = np.stack([s.x for s in states])
        return Track(
            position=x[:, P],
            attitude=np.stack([s.quat for s in states]),
            velocity=x[:, V],
            rate=self.inputs.rate - x[:, BG],
            gyro_bias=x[:, BG],
            accel_bias=x[:, BA],
            covariance=np.stack([s[:SIZE, :SIZE] for s in spreads]),
            likelihood=self.likelihood,
        )


def likeliest(inputs: Inputs, noise: Sequence[Noise], quat: Array) -> Noise:
    """Return the noise that makes the measurements most likely. quat: `[4]`, the first orientation."""
    return max(noise, key=lambda own: float(np.nan_to_num(_Filter(inputs, own, quat).likelihood, nan=-np.inf)))
