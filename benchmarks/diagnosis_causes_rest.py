"""Causes at the base and the sensors, and those that no library knows."""

import math
from collections import deque
from typing import TYPE_CHECKING

import mujoco
import numpy as np
from diagnosis_causes import JOINT, Cause, Friction
from diagnosis_causes_more import (
    ActuatorBias,
    ActuatorDeadband,
    ActuatorDelay,
    ActuatorGain,
    ActuatorLag,
    ActuatorSaturation,
    Cogging,
    EffortLoss,
    ExternalForce,
    GravityTilt,
    Payload,
    RateLimit,
    SpeedTorqueLimit,
    _Actuator,
)

if TYPE_CHECKING:
    from diagnosis_truth import Plant


class BaseFlexibility(Cause):
    """The base leans on springs about its horizontal axes, unseen by any encoder."""

    name = "base_flexibility"
    kind = "world"

    def draw(self, rng: np.random.Generator) -> None:
        self.zeta = rng.uniform(0.03, 0.1)
        self.inertia = 0.05 * sum(self.scales.mass.values())
        self.smallest = 1 / (self.inertia * (2 * np.pi * 30) ** 2)
        self.largest = 1 / (self.inertia * (2 * np.pi * 2) ** 2)

    def edit(self, spec: mujoco.MjSpec) -> None:
        k = 1 / max(self.size, self.smallest)
        base = spec.body("base")
        for name, axis in (("base/x", [1, 0, 0]), ("base/y", [0, 1, 0])):
            joint = base.add_joint(name=name, axis=axis, pos=[0, 0, -0.3], armature=0.1 * self.inertia)
            joint.stiffness[0], joint.damping[0] = k, 2 * self.zeta * math.sqrt(k * self.inertia)

    def parameters(self) -> dict[str, float]:
        return {"stiffness": 1 / max(self.size, self.smallest)}


class JointOffset(Cause):
    """The encoder's zero is wrong: everything that reads it, the servo included."""

    name = "joint_offset"
    largest = 0.15

    def draw(self, rng: np.random.Generator) -> None:
        self.sign = float(rng.choice([-1, 1]))

    def edit(self, spec: mujoco.MjSpec) -> None:
        if self.scales.servo:
            actuator = next(a for a, joint in self.scales.drives.items() if joint == self.where)
            servo = spec.actuator(actuator)
            servo.biasprm[0] += servo.biasprm[1] * self.sign * self.size

    def sense(self, plant: "Plant", q: np.ndarray, v: np.ndarray) -> None:
        q[plant.column(self.where)] += self.sign * self.size

    def parameters(self) -> dict[str, float]:
        return {"offset": self.sign * self.size}


class SensorDelay(Cause):
    """Old readings: a buffer of true positions, interpolated."""

    name = "sensor_delay"
    stepped = True
    largest = 0.06

    def reset(self, plant: "Plant", command: np.ndarray) -> None:
        lag = self.size / plant.timestep
        self.whole, self.part = int(lag), lag - int(lag)
        self.buffer: deque[tuple[float, float]] = deque(maxlen=self.whole + 2)

    def watch(self, plant: "Plant", q: np.ndarray, v: np.ndarray) -> None:
        i = plant.column(self.where)
        self.buffer.append((float(q[i]), float(v[i])))

    def sense(self, plant: "Plant", q: np.ndarray, v: np.ndarray) -> None:
        i = plant.column(self.where)
        recent = self.buffer[max(len(self.buffer) - 1 - self.whole, 0)]
        older = self.buffer[max(len(self.buffer) - 2 - self.whole, 0)]
        q[i], v[i] = ((1 - self.part) * a + self.part * b for a, b in zip(recent, older, strict=True))

    def parameters(self) -> dict[str, float]:
        return {"delay": self.size}


class SensorFilter(Cause):
    """First-order low pass of the readings, exact per sub-step."""

    name = "sensor_filter"
    stepped = True
    largest = 0.08
    smallest = 1e-4

    def reset(self, plant: "Plant", command: np.ndarray) -> None:
        self.state: tuple[float, float] | None = None
        self.keep = math.exp(-plant.timestep / max(self.size, self.smallest))

    def watch(self, plant: "Plant", q: np.ndarray, v: np.ndarray) -> None:
        i = plant.column(self.where)
        new = (float(q[i]), float(v[i]))
        old = self.state or new
        self.state = tuple(self.keep * a + (1 - self.keep) * b for a, b in zip(old, new, strict=True))  # type: ignore[assignment]

    def sense(self, plant: "Plant", q: np.ndarray, v: np.ndarray) -> None:
        i = plant.column(self.where)
        assert self.state
        q[i], v[i] = self.state

    def parameters(self) -> dict[str, float]:
        return {"time": self.size}


class SensorGain(Cause):
    name = "sensor_gain"
    largest = 0.2

    def draw(self, rng: np.random.Generator) -> None:
        self.sign = float(rng.choice([-1, 1]))

    def sense(self, plant: "Plant", q: np.ndarray, v: np.ndarray) -> None:
        i = plant.column(self.where)
        q[i] *= 1 + self.sign * self.size
        v[i] *= 1 + self.sign * self.size

    def parameters(self) -> dict[str, float]:
        return {"gain": 1 + self.sign * self.size}


class PositionHysteresis(Friction):
    """Unknown to the library: bristles that grip only in some angles, so that the loop's width depends on position."""

    name = "unknown_position_hysteresis"

    def draw(self, rng: np.random.Generator) -> None:
        super().draw(rng)
        low, high = self.scales.travel[self.where]
        self.wave, self.phase = rng.uniform(2.0, 3.5) * 2 * np.pi / (high - low), rng.uniform(0, 2 * np.pi)

    def level(self, plant: "Plant", w: float) -> float:
        q = float(plant.data.qpos[plant.address(self.where)])
        return self.size * max(math.sin(self.wave * q + self.phase), 1e-3)


class CrossCoupling(_Actuator):
    """Unknown to the library: part of this actuator's effort arrives at another joint (a differential, a taut cable)."""

    name = "unknown_cross_coupling"
    stepped = True

    def draw(self, rng: np.random.Generator) -> None:
        self.other = str(rng.choice([j for j in self.scales.force if j != self.joint]))

    def force(self, plant: "Plant") -> None:
        effort = plant.data.qfrc_actuator[plant.dof(self.joint)]
        plant.data.qfrc_applied[plant.dof(self.other)] += self.size * effort


class VaryingGain(_Actuator):
    """Unknown to the library: the gain wanders with time."""

    name = "unknown_varying_gain"
    largest = 0.9
    stepped = True

    def draw(self, rng: np.random.Generator) -> None:
        self.rate, self.phase = rng.uniform(0.25, 0.6), rng.uniform(0, 2 * np.pi)

    def reset(self, plant: "Plant", command: np.ndarray) -> None:
        super().reset(plant, command)
        self.gain = plant.model.actuator_gainprm[self.id].copy()
        self.bias = plant.model.actuator_biasprm[self.id].copy()

    def command(self, plant: "Plant", u: np.ndarray) -> None:
        g = 1 + self.size * math.sin(2 * math.pi * self.rate * plant.data.time + self.phase)
        plant.model.actuator_gainprm[self.id] = self.gain * g
        plant.model.actuator_biasprm[self.id] = self.bias * g


class Pushes(Cause):
    """Unknown to the library: somebody pushes at times that no log tells."""

    name = "unknown_pushes"
    kind = "body"
    stepped = True

    def draw(self, rng: np.random.Generator) -> None:
        self.seed = int(rng.integers(2**31))
        self.runs = 0
        self.largest = 10 * max(self.scales.force.values())

    def reset(self, plant: "Plant", command: np.ndarray) -> None:
        self.id = plant.model.body(self.where).id
        rng = np.random.default_rng((self.seed, round(1e6 * float(np.sum(np.abs(command))))))
        self.starts = np.sort(rng.uniform(0.2, 3.7, 4))
        self.forces = rng.uniform(0.5, 1.0, (4, 1)) * rng.choice([-1, 1], (4, 1)) * [1.0, 0.6, 0.2]

    def force(self, plant: "Plant") -> None:
        for start, force in zip(self.starts, self.forces, strict=True):
            s = (plant.data.time - start) / 0.25
            if 0 < s < 1:
                plant.data.xfrc_applied[self.id, :3] += self.size * math.sin(math.pi * s) * force


_KNOWN = (
    *JOINT, ActuatorDelay, ActuatorLag, ActuatorGain, ActuatorBias, ActuatorDeadband, ActuatorSaturation, SpeedTorqueLimit,
    EffortLoss, Cogging, RateLimit, Payload, GravityTilt, ExternalForce, BaseFlexibility, JointOffset, SensorDelay,
    SensorFilter, SensorGain,
)  # fmt: skip
KNOWN: dict[str, type[Cause]] = {c.name: c for c in _KNOWN}
UNKNOWN: dict[str, type[Cause]] = {c.name: c for c in (PositionHysteresis, CrossCoupling, VaryingGain, Pushes)}
