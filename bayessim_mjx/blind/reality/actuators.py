"""Causes at actuators; efforts are the actuator's, joint forces over the gear."""

import math
from collections import deque

import mujoco
import numpy as np

from bayessim_mjx.blind.reality.cause import Cause, Simulated


class ActuatorCause(Cause):
    kind = "actuator"

    @property
    def joint(self) -> str:
        return self.scales.drives[self.where]

    def reset(self, plant: Simulated, command: np.ndarray) -> None:
        self.id = plant.model.actuator(self.where).id
        self.value = float(command[self.id])
        self.gear = float(plant.model.actuator_gear[self.id, 0])


class ActuatorDelay(ActuatorCause):
    """A buffer of commands; times in between are interpolated."""

    name = "actuator_delay"
    stepped = True
    largest = 0.08

    def reset(self, plant: Simulated, command: np.ndarray) -> None:
        super().reset(plant, command)
        lag = self.size / plant.timestep
        self.whole, self.part = int(lag), lag - int(lag)
        self.buffer = deque([self.value] * (self.whole + 2), maxlen=self.whole + 2)

    def command(self, plant: Simulated, u: np.ndarray) -> None:
        self.buffer.append(float(u[self.id]))
        u[self.id] = (1 - self.part) * self.buffer[1] + self.part * self.buffer[0]

    def parameters(self) -> dict[str, float]:
        return {"delay": self.size}


class ActuatorLag(ActuatorCause):
    """MuJoCo's filterexact."""

    name = "actuator_lag"
    largest = 0.15
    smallest = 1e-4

    def edit(self, spec: mujoco.MjSpec) -> None:
        actuator = spec.actuator(self.where)
        actuator.dyntype = mujoco.mjtDyn.mjDYN_FILTEREXACT
        actuator.dynprm[0] = max(self.size, self.smallest)

    def reset(self, plant: Simulated, command: np.ndarray) -> None:
        super().reset(plant, command)
        plant.data.act[plant.model.actuator_actadr[self.id]] = self.value

    def parameters(self) -> dict[str, float]:
        return {"time_constant": self.size}


class ActuatorGain(ActuatorCause):
    name = "actuator_gain"
    largest = 0.6

    def draw(self, rng: np.random.Generator) -> None:
        self.sign = float(rng.choice([-1, 1]))

    def edit(self, spec: mujoco.MjSpec) -> None:
        actuator, g = spec.actuator(self.where), 1 + self.sign * self.size
        actuator.gainprm = actuator.gainprm * g
        actuator.biasprm = actuator.biasprm * g

    def parameters(self) -> dict[str, float]:
        return {"gain": 1 + self.sign * self.size}


class ServoStiffness(ActuatorGain):
    """The servo's kp alone; its kv and force limit are the model's."""

    name = "servo_stiffness"
    largest = 0.7

    def edit(self, spec: mujoco.MjSpec) -> None:
        actuator = spec.actuator(self.where)
        actuator.gainprm[0] *= 1 + self.sign * self.size
        actuator.biasprm[1] *= 1 + self.sign * self.size

    def parameters(self) -> dict[str, float]:
        return {"factor": 1 + self.sign * self.size}


class ServoDamping(ServoStiffness):
    """The servo's kv alone."""

    name = "servo_damping"

    def edit(self, spec: mujoco.MjSpec) -> None:
        spec.actuator(self.where).biasprm[2] *= 1 + self.sign * self.size


class ActuatorBias(ActuatorCause):
    name = "actuator_bias"

    def draw(self, rng: np.random.Generator) -> None:
        self.sign = float(rng.choice([-1, 1]))
        self.largest = 0.4 * self.scales.effort[self.where]

    def edit(self, spec: mujoco.MjSpec) -> None:
        actuator = spec.actuator(self.where)
        actuator.biastype = mujoco.mjtBias.mjBIAS_AFFINE
        actuator.biasprm[0] += self.sign * self.size

    def parameters(self) -> dict[str, float]:
        return {"bias": self.sign * self.size}


class ActuatorDeadband(ActuatorCause):
    """Of the command; in a servo of its position error."""

    name = "actuator_deadband"
    stepped = True

    def draw(self, rng: np.random.Generator) -> None:
        self.largest = 0.05 if self.where in self.scales.servo else 0.4 * self.scales.command[self.where]

    def command(self, plant: Simulated, u: np.ndarray) -> None:
        origin = self.gear * plant.position(self.joint) if self.where in self.scales.servo else 0.0
        error = u[self.id] - origin
        u[self.id] = origin + math.copysign(max(abs(error) - self.size, 0.0), error)

    def parameters(self) -> dict[str, float]:
        return {"half_width": self.size}


class ActuatorSaturation(ActuatorCause):
    """MuJoCo's forcerange; the size is the largest effort over the limit, less one."""

    name = "actuator_saturation"
    largest = 4.0

    def edit(self, spec: mujoco.MjSpec) -> None:
        limit = self.limit
        spec.actuator(self.where).forcelimited = True
        spec.actuator(self.where).forcerange = [-limit, limit]

    @property
    def limit(self) -> float:
        return self.scales.effort[self.where] / (1 + self.size)

    def parameters(self) -> dict[str, float]:
        return {"inverse_limit": 1 / self.limit}


class SpeedTorqueLimit(ActuatorCause):
    """|tau| <= stall (1 - |w| / w0) when driving, stall when braking: forcerange moved in every sub-step."""

    name = "speed_torque_limit"
    stepped = True
    largest = 8.0
    smallest = 0.05

    def draw(self, rng: np.random.Generator) -> None:
        self.stall = rng.uniform(1.0, 1.3) * self.scales.effort[self.where]

    def edit(self, spec: mujoco.MjSpec) -> None:
        spec.actuator(self.where).forcelimited = True
        spec.actuator(self.where).forcerange = [-self.stall, self.stall]

    @property
    def free_speed(self) -> float:
        return self.scales.speed[self.joint] / max(self.size, self.smallest)

    def command(self, plant: Simulated, u: np.ndarray) -> None:
        w = self.gear * float(plant.data.qvel[plant.dof(self.joint)]) / self.free_speed
        plant.model.actuator_forcerange[self.id] = (
            -self.stall * min(max(1 + w, 0.0), 1.0),
            self.stall * min(max(1 - w, 0.0), 1.0),
        )

    def parameters(self) -> dict[str, float]:
        return {"inverse_stall": 1 / self.stall, "inverse_speed": 1 / self.free_speed}


class ChangingGain(ActuatorCause):
    """Gives a share of its effort, another one in every sub-step."""

    stepped = True

    def reset(self, plant: Simulated, command: np.ndarray) -> None:
        super().reset(plant, command)
        self.gain = plant.model.actuator_gainprm[self.id].copy()
        self.bias = plant.model.actuator_biasprm[self.id].copy()

    def scale(self, plant: Simulated, share: float) -> None:
        plant.model.actuator_gainprm[self.id] = self.gain * share
        plant.model.actuator_biasprm[self.id] = self.bias * share


class EffortLoss(ChangingGain):
    """Sag behind a source resistance: u / (1 + c |u|); in a servo of its effort, by its gains."""

    name = "effort_loss"
    largest = 1.5

    def command(self, plant: Simulated, u: np.ndarray) -> None:
        w = self.gear * float(plant.data.qvel[plant.dof(self.joint)])
        q = self.gear * plant.position(self.joint)
        tau = self.gain[0] * u[self.id] + self.bias @ (1, q, w, *[0] * (len(self.bias) - 3))
        self.scale(plant, 1 / (1 + self.size * abs(tau) / self.scales.effort[self.where]))

    def parameters(self) -> dict[str, float]:
        return {"loss": self.size / self.scales.effort[self.where]}


class Cogging(ActuatorCause):
    name = "cogging"
    stepped = True

    def draw(self, rng: np.random.Generator) -> None:
        self.count, self.phase = int(rng.integers(6, 25)), rng.uniform(0, 2 * np.pi)
        self.largest = 0.5 * self.scales.force[self.joint]

    def force(self, plant: Simulated) -> None:
        q = plant.data.qpos[plant.address(self.joint)]
        plant.data.qfrc_applied[plant.dof(self.joint)] += self.size * math.sin(self.count * q + self.phase)

    def parameters(self) -> dict[str, float]:
        a, p = self.size, self.phase
        return {"sine": a * math.cos(p), "cosine": a * math.sin(p), "order": self.count}


class RateLimit(ActuatorCause):
    """The size is the 99 % quantile of the command's rate over the limit."""

    name = "rate_limit"
    stepped = True
    largest = 50.0
    smallest = 0.02

    @property
    def limit(self) -> float:
        return self.scales.rate[self.where] / max(self.size, self.smallest)

    def command(self, plant: Simulated, u: np.ndarray) -> None:
        reach, before = self.limit * plant.timestep, self.value
        self.value += min(max(float(u[self.id]) - before, -reach), reach)
        u[self.id] = 0.5 * (before + self.value)  # its mean over the step: its end would be half a step early

    def parameters(self) -> dict[str, float]:
        return {"slowness": 1 / self.limit}
