"""Causes that no library knows: the honest verdict is that something unexplained is there."""

import math

import numpy as np

from bayessim_mjx.blind.reality.actuators import ActuatorCause, ChangingGain
from bayessim_mjx.blind.reality.cause import Cause, Simulated
from bayessim_mjx.blind.reality.joints import Friction


class PositionHysteresis(Friction):
    """Bristles that grip only in some angles, so that the loop's width depends on position."""

    name = "unknown_position_hysteresis"

    def draw(self, rng: np.random.Generator) -> None:
        super().draw(rng)
        low, high = self.scales.travel[self.where]
        self.wave, self.phase = rng.uniform(2.0, 3.5) * 2 * np.pi / (high - low), rng.uniform(0, 2 * np.pi)

    def level(self, plant: Simulated, w: float) -> float:
        q = float(plant.data.qpos[plant.address(self.where)])
        return self.size * max(math.sin(self.wave * q + self.phase), 1e-3)


class CrossSpring(ActuatorCause):
    """A hose or cable over two joints: a torque at this actuator's joint that depends on another one's position."""

    name = "unknown_cross_spring"
    stepped = True

    def draw(self, rng: np.random.Generator) -> None:
        self.other = str(rng.choice([j for j in self.scales.force if j != self.joint]))
        low, high = self.scales.travel[self.other]
        self.wave, self.middle = rng.uniform(1.0, 2.5) * np.pi / (high - low), rng.uniform(low, high)
        self.largest = 3 * self.scales.force[self.joint]

    def force(self, plant: Simulated) -> None:
        way = float(plant.data.qpos[plant.address(self.other)]) - self.middle
        plant.data.qfrc_applied[plant.dof(self.joint)] += self.size * math.sin(self.wave * way)


class VaryingGain(ChangingGain):
    """The gain wanders with time."""

    name = "unknown_varying_gain"
    largest = 0.9

    def draw(self, rng: np.random.Generator) -> None:
        self.rate, self.phase = rng.uniform(0.25, 0.6), rng.uniform(0, 2 * np.pi)

    def command(self, plant: Simulated, u: np.ndarray) -> None:
        self.scale(plant, 1 + self.size * math.sin(2 * math.pi * self.rate * plant.data.time + self.phase))


class Pushes(Cause):
    """Somebody pushes at times that no log has."""

    name = "unknown_pushes"
    kind = "body"
    stepped = True

    def draw(self, rng: np.random.Generator) -> None:
        self.seed = int(rng.integers(2**31))
        self.runs = 0
        self.largest = 10 * max(self.scales.force.values())

    def reset(self, plant: Simulated, command: np.ndarray) -> None:
        self.id = plant.model.body(self.where).id
        rng = np.random.default_rng((self.seed, round(1e6 * float(np.sum(np.abs(command))))))
        self.starts = np.sort(rng.uniform(0.2, 3.7, 4))
        self.forces = rng.uniform(0.5, 1.0, (4, 1)) * rng.choice([-1, 1], (4, 1)) * [1.0, 0.6, 0.2]

    def force(self, plant: Simulated) -> None:
        for start, force in zip(self.starts, self.forces, strict=True):
            s = (plant.data.time - start) / 0.25
            if 0 < s < 1:
                plant.data.xfrc_applied[self.id, :3] += self.size * math.sin(math.pi * s) * force
