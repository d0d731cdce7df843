"""Causes at joints."""

import math

import mujoco
import numpy as np

from bayessim_mjx.blind.reality.cause import Cause, Simulated

PRESLIDING = 2e-4  # rad or m, bend of the bristles at the friction level: a choice, below the encoders' noise
STIFF = 0.03  # of inertia / step^2: at most what the sub-step can integrate


class Bristle:
    """LuGre: w = dq/dt, z' = w - s0 |w| z / g, F = -(s0 z + s1 z')."""

    def __init__(
        self, level: float, inertia: float, timestep: float, bend: float = PRESLIDING, tame: bool = True
    ) -> None:
        self.s0 = min(level / bend, STIFF * inertia / timestep**2)
        self.s1 = 1.4 * math.sqrt(self.s0 * inertia)
        self.timestep, self.tame, self.z = timestep, tame, 0.0

    def step(self, w: float, level: float) -> float:
        """Friction force at speed w where the steady one is `level`; exact in z for constant w."""
        if level <= 0 or self.s0 <= 0:
            return 0.0
        rate = self.s0 * abs(w) / level
        decay = math.exp(-rate * self.timestep)
        before = self.z
        self.z = before * decay + (w * (1 - decay) / rate if rate > 1e-9 else w * self.timestep)
        # the bristles' own damping must not brake a fast joint: no more than the level, so that LuGre stays passive
        damping = min(self.s1, level / abs(w)) if w and self.tame else self.s1
        return -(self.s0 * self.z + damping * (self.z - before) / self.timestep)


class Friction(Cause):
    """Bristles under a level that the subclass gives."""

    stepped = True
    tame = True

    def draw(self, rng: np.random.Generator) -> None:
        self.largest = 0.6 * self.scales.force[self.where]

    def highest(self) -> float:
        return self.size

    def bend(self) -> float:
        """Of the bristles under the highest level."""
        return PRESLIDING

    def level(self, plant: Simulated, w: float) -> float:
        return self.size

    def reset(self, plant: Simulated, command: np.ndarray) -> None:
        self.dof = plant.dof(self.where)
        inertia = self.scales.inertia[self.where]
        self.bristle = Bristle(self.highest(), inertia, plant.timestep, self.bend(), self.tame)

    def force(self, plant: Simulated) -> None:
        w = float(plant.data.qvel[self.dof])
        plant.data.qfrc_applied[self.dof] += self.bristle.step(w, self.level(plant, w))


class CoulombFriction(Friction):
    name = "coulomb_friction"

    def parameters(self) -> dict[str, float]:
        return {"level": self.size}


class StribeckFriction(Friction):
    """Level falls from `ratio` times the Coulomb one within the Stribeck speed."""

    name = "stribeck_friction"

    def draw(self, rng: np.random.Generator) -> None:
        super().draw(rng)
        self.ratio = rng.uniform(1.7, 2.5)
        self.speed = rng.uniform(0.05, 0.15) * self.scales.speed[self.where]

    def highest(self) -> float:
        return self.ratio * self.size

    def level(self, plant: Simulated, w: float) -> float:
        return self.size * (1 + (self.ratio - 1) * math.exp(-((w / self.speed) ** 2)))

    def parameters(self) -> dict[str, float]:
        return {"level": self.size, "excess": (self.ratio - 1) * self.size, "speed": self.speed}


class LoadFriction(Friction):
    """Level proportional to what the gear transmits: the drive's force against the load's."""

    name = "load_friction"

    def draw(self, rng: np.random.Generator) -> None:
        self.largest = 0.5

    def highest(self) -> float:
        return self.size * self.scales.force[self.where]

    def level(self, plant: Simulated, w: float) -> float:
        d = plant.data
        return self.size * abs(d.qfrc_actuator[self.dof] + d.qfrc_bias[self.dof])

    def parameters(self) -> dict[str, float]:
        return {"motor": self.size, "external": self.size}


class AsymmetricFriction(Friction):
    """One direction has the level, the other a fraction of it."""

    name = "asymmetric_friction"

    def draw(self, rng: np.random.Generator) -> None:
        super().draw(rng)
        self.part, self.side = rng.uniform(0.0, 0.35), float(rng.choice([-1, 1]))

    def level(self, plant: Simulated, w: float) -> float:
        return self.size * (1.0 if w * self.side > 0 else max(self.part, 1e-3))

    def parameters(self) -> dict[str, float]:
        high, low = (self.size, self.part * self.size)[:: int(self.side)]
        return {"level_forward": high, "level_backward": low}


class ViscousFriction(Cause):
    name = "viscous_friction"

    def draw(self, rng: np.random.Generator) -> None:
        self.largest = 2 * self.scales.force[self.where] / self.scales.speed[self.where]

    def edit(self, spec: mujoco.MjSpec) -> None:
        spec.joint(self.where).damping[0] += self.size

    def parameters(self) -> dict[str, float]:
        return {"damping": self.size}


class QuadraticDrag(Cause):
    name = "quadratic_drag"

    def draw(self, rng: np.random.Generator) -> None:
        self.largest = 2 * self.scales.force[self.where] / self.scales.speed[self.where] ** 2

    def edit(self, spec: mujoco.MjSpec) -> None:
        spec.joint(self.where).damping[1] += self.size

    def parameters(self) -> dict[str, float]:
        return {"coefficient": self.size}


class Armature(Cause):
    name = "armature"

    def draw(self, rng: np.random.Generator) -> None:
        self.largest = 2 * self.scales.inertia[self.where]

    def edit(self, spec: mujoco.MjSpec) -> None:
        spec.joint(self.where).armature += self.size

    def parameters(self) -> dict[str, float]:
        return {"inertia": self.size}


class JointSpring(Cause):
    """Linear or (one in three) cubic, with a rest position inside the range of motion."""

    name = "joint_spring"

    def draw(self, rng: np.random.Generator) -> None:
        low, high = self.scales.travel[self.where]
        self.rest = rng.uniform(low, high)
        self.order = 2 if rng.uniform() < 1 / 3 else 0
        self.largest = 1.5 * self.scales.force[self.where] / (high - low) ** (self.order + 1)

    def edit(self, spec: mujoco.MjSpec) -> None:
        joint = spec.joint(self.where)
        joint.stiffness[self.order] += self.size
        joint.springref = self.rest

    def parameters(self) -> dict[str, float]:
        return {"cubic" if self.order else "stiffness": self.size, "rest": self.rest}


class CableTension(Cause):
    """A cable beside the joint, MuJoCo's tendon: slack up to an angle; one in three has a softer one against it."""

    name = "cable_tension"

    def draw(self, rng: np.random.Generator) -> None:
        low, high = self.scales.travel[self.where]
        self.taut = rng.uniform(low + 0.2 * (high - low), high - 0.2 * (high - low))
        self.side = float(rng.choice([-1, 1]))
        self.other = rng.uniform(0.1, 0.5) if rng.uniform() < 1 / 3 else 0.0
        self.largest = 3 * self.scales.force[self.where] / (high - low)

    def edit(self, spec: mujoco.MjSpec) -> None:
        far = 1e6  # m or rad: never reached
        forward, backward, taut = self.parameters().values()
        for k, stiffness, slack in ((0, forward, (-far, taut)), (1, backward, (taut, far))):
            if stiffness:
                cable = spec.add_tendon(name=f"{self.where}/cable{k}", springlength=slack)
                cable.wrap_joint(self.where, 1.0)
                cable.stiffness[0] = stiffness

    def parameters(self) -> dict[str, float]:
        forward, backward = (self.size, self.other * self.size)[:: int(self.side)]
        return {"forward": forward, "backward": backward, "taut": self.taut}


class TwoBodies(Cause):
    """A second joint behind the rotor: rotor inertia is the joint's armature, the encoder sits on the link."""

    def draw(self, rng: np.random.Generator) -> None:
        self.zeta = rng.uniform(0.05, 0.1)

    def behind(self, spec: mujoco.MjSpec) -> mujoco.MjsJoint:
        rotor = spec.joint(self.where)
        return rotor.parent.add_joint(
            name=f"{self.where}/play", type=rotor.type, axis=rotor.axis, pos=rotor.pos, armature=1e-3 * rotor.armature
        )


class Backlash(TwoBodies):
    name = "backlash"
    largest = 0.1

    def edit(self, spec: mujoco.MjSpec) -> None:
        joint, h = self.behind(spec), self.size / 2
        joint.limited, joint.range = True, [-h, h]
        joint.solref_limit = [4 * self.scales.timestep, 1.0]
        joint.solimp_limit = [0.95, 0.99, 1e-4, 0.5, 2]
        joint.damping[0] = 0.02 * spec.joint(self.where).damping[0]

    def parameters(self) -> dict[str, float]:
        return {"gap": self.size / 2}


class JointElasticity(TwoBodies):
    name = "joint_elasticity"

    def draw(self, rng: np.random.Generator) -> None:
        super().draw(rng)
        inertia = self.scales.inertia[self.where]
        self.largest = 1 / (inertia * (2 * np.pi * 2.5) ** 2)  # a mode of 2.5 Hz; the other end 40 Hz
        self.smallest = 1 / (inertia * (2 * np.pi * 40.0) ** 2)

    def edit(self, spec: mujoco.MjSpec) -> None:
        joint, k = self.behind(spec), 1 / max(self.size, self.smallest)
        joint.stiffness[0] = k
        joint.damping[0] = 2 * self.zeta * math.sqrt(k * self.scales.inertia[self.where])

    def parameters(self) -> dict[str, float]:
        return {"compliance": max(self.size, self.smallest)}
