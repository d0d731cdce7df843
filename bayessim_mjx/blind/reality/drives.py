"""Causes in drives that change with time, or plan their own way to a command."""

import math

import mujoco
import numpy as np

from bayessim_mjx.blind.reality.actuators import ActuatorCause, ChangingGain
from bayessim_mjx.blind.reality.cause import Past, Simulated


class GainDrift(ChangingGain):
    """Fades (or comes in) evenly from the first row of a log on, and its limit of force with it."""

    name = "gain_drift"
    model: mujoco.MjModel | None = None

    def draw(self, rng: np.random.Generator) -> None:
        self.sign = float(rng.choice([-1, 1]))  # the largest one fades to nothing in a minute

    def reset(self, plant: Simulated, command: np.ndarray) -> None:
        super().reset(plant, command)
        self.begun = 0.0
        if self.model is not plant.model:
            self.model, self.limit = plant.model, plant.model.actuator_forcerange[self.id].copy()

    def resume(self, plant: Simulated, past: Past) -> None:
        self.begun = float(past.time[-1])

    def command(self, plant: Simulated, u: np.ndarray) -> None:
        minutes = (self.begun + plant.data.time) / 60
        share = max(1 + self.sign * self.size * minutes, 0.0)
        self.scale(plant, share)
        plant.model.actuator_forcerange[self.id] = self.limit * share

    def parameters(self) -> dict[str, float]:
        return {"drift": self.sign * self.size}


class EffortCoupling(ActuatorCause):
    """Part of this actuator's effort arrives at the joint before or behind its own (a differential, a taut cable)."""

    name = "effort_coupling"
    stepped = True

    def draw(self, rng: np.random.Generator) -> None:
        self.sign = float(rng.choice([-1, 1]))
        before, behind = self.scales.chain[self.joint]
        self.other = str(rng.choice([j for j in (before, behind) if j]))

    def reset(self, plant: Simulated, command: np.ndarray) -> None:
        super().reset(plant, command)
        model, self.at = plant.model, plant.model.joint(self.joint).id
        here = (model.actuator_trntype == mujoco.mjtTrn.mjTRN_JOINT) & (model.actuator_trnid[:, 0] == self.at)
        self.gears = np.where(here, model.actuator_gear[:, 0], 0.0)

    def force(self, plant: Simulated) -> None:
        model, data = plant.model, plant.data
        effort, asked = self.gear * data.actuator_force[self.id], self.gears @ data.actuator_force
        asked += model.jnt_actgravcomp[self.at] * data.qfrc_gravcomp[plant.dof(self.joint)]
        if model.jnt_actfrclimited[self.at] and asked:
            effort *= np.clip(asked, *model.jnt_actfrcrange[self.at]) / asked
        plant.data.qfrc_applied[plant.dof(self.other)] += self.sign * self.size * effort

    def parameters(self) -> dict[str, float]:
        behind = self.other == self.scales.chain[self.joint][1]
        share = self.sign * self.size
        return {"to_next": share if behind else 0.0, "to_previous": 0.0 if behind else share}


class AccelerationLimit(ActuatorCause):
    """The quickest way to the command within a speed and an acceleration, planned anew in every sub-step.

    The size is s^2, the largest command over the acceleration; half of them have a limit of speed too.
    """

    name = "acceleration_limit"
    stepped = True
    largest = 0.5

    def draw(self, rng: np.random.Generator) -> None:
        self.smallest = self.scales.timestep**2
        self.slow = rng.uniform(0.5, 1.5) if rng.uniform() < 0.5 else 0.0

    def reset(self, plant: Simulated, command: np.ndarray) -> None:
        super().reset(plant, command)
        self.rate = 0.0

    def resume(self, plant: Simulated, past: Past) -> None:
        self.value, self.rate = float(past.u[0, self.id]), 0.0
        for u, seconds in zip(past.u[:-1, self.id], np.diff(past.time), strict=True):
            self.follow(float(u), float(seconds))

    def command(self, plant: Simulated, u: np.ndarray) -> None:
        before = self.value
        self.follow(float(u[self.id]), plant.timestep)
        u[self.id] = 0.5 * (before + self.value)

    def follow(self, command: float, seconds: float) -> None:
        """Towards a command for some seconds."""
        own = self.parameters()
        top = 1 / own["slowness"] if own["slowness"] else math.inf
        way, self.rate = quickest(command - self.value, self.rate, top, 1 / own["inertness"], seconds)
        self.value += way

    def parameters(self) -> dict[str, float]:
        size, most = max(self.size, self.smallest), max(self.scales.command[self.where], 1e-12)
        return {"slowness": self.slow * math.sqrt(size) / most, "inertness": size / most}


def quickest(way: float, rate: float, top: float, acceleration: float, seconds: float) -> tuple[float, float]:
    """(way gone, rate) after some seconds of the quickest motion over `way` that ends at rest, from `rate` on."""
    # where stopping at once would end short of the way, speed up along it, else against it
    side = 1.0 if way >= 0.5 * rate * abs(rate) / acceleration else -1.0
    way, rate, gone, left = side * way, side * rate, 0.0, seconds
    peak = min(math.sqrt(max(acceleration * way + 0.5 * rate * rate, 0.0)), top)
    cruise = (way - (peak * peak - 0.5 * rate * rate) / acceleration) / peak if peak > 0 else 0.0
    phases = ((acceleration, (peak - rate) / acceleration), (0.0, cruise), (-acceleration, peak / acceleration))
    for change, span in phases:
        t = min(max(span, 0.0), left)
        gone, rate, left = gone + rate * t + 0.5 * change * t * t, rate + change * t, left - t
    return (side * gone, side * rate) if left <= 0 else (side * way, 0.0)
