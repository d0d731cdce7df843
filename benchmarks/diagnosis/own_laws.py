"""Laws of causes as nature has them where the library's effect is simpler; sizes and parameters keep their meaning.

- **Dry friction** (coulomb, stribeck, load, asymmetric): LuGre bristles that bend by BEND before they slip, so that
  encoders see it (Canudas de Wit et al., IEEE Trans. Automat. Control 40, 1995). Stribeck's level falls with
  exp(-|w / speed|), as Tustin has it, in place of exp(-(w / speed)^2).
- **Backlash**: two bodies with a gap between them; flanks push by Hunt and Crossley's law (J. Appl. Mech. 42, 1975).
- **Joint elasticity**: two bodies with a gear between them that hardens with its torque. The compliance is that
  without load.
- **Cogging**: a second harmonic beside the first one. The parameters are those of the first.
"""

import math
from collections.abc import Sequence

import mujoco
import numpy as np
from turns import SECOND_BODY

from bayessim_mjx.blind.reality.actuators import Cogging
from bayessim_mjx.blind.reality.cause import Cause, Simulated
from bayessim_mjx.blind.reality.joints import (
    AsymmetricFriction,
    Backlash,
    CoulombFriction,
    Friction,
    JointElasticity,
    LoadFriction,
    StribeckFriction,
)

BEND = 1e-3  # rad or m: two to three standard deviations of the encoders; of geared joints it is 3e-4 to 3e-3 rad
FLANK = 0.5  # of a flank's natural frequency times the step: twice as stiff as MuJoCo's stop, and stable below 2
LOSS = 0.3  # s/rad: of its speed v a link loses a share of LOSS v where a flank throws it back
HARDENING = 0.6  # by which a gear is stiffer under the joint's largest force: K3 over K1 of harmonic drives is 1.5 to 2
SECOND = 0.25  # of the first harmonic of cogging


class Bristled(Friction):
    """Bristles whose bend shows."""

    def bend(self) -> float:
        return BEND


class OwnCoulomb(Bristled, CoulombFriction):
    pass


class OwnStribeck(Bristled, StribeckFriction):
    def level(self, plant: Simulated, w: float) -> float:
        return self.size * (1 + (self.ratio - 1) * math.exp(-abs(w / self.speed)))


class OwnLoad(Bristled, LoadFriction):
    pass


class OwnAsymmetric(Bristled, AsymmetricFriction):
    pass


class OwnBacklash(Backlash):
    stepped = True

    def edit(self, spec: mujoco.MjSpec) -> None:
        self.behind(spec).damping[0] = 0.02 * spec.joint(self.where).damping[0]

    def reset(self, plant: Simulated, command: np.ndarray) -> None:
        play = plant.model.joint(f"{self.where}/play").id
        self.address, self.dof = int(plant.model.jnt_qposadr[play]), int(plant.model.jnt_dofadr[play])
        self.stiffness = (FLANK / plant.timestep) ** 2 / float(plant.model.dof_invweight0[self.dof])

    def force(self, plant: Simulated) -> None:
        at, speed = float(plant.data.qpos[self.address]), float(plant.data.qvel[self.dof])
        depth, side = abs(at) - self.size / 2, math.copysign(1.0, at)
        if depth > 0:
            pressed = self.stiffness * depth * (1 + 1.5 * LOSS * side * speed)
            plant.data.qfrc_applied[self.dof] -= side * max(pressed, 0.0)


class OwnElasticity(JointElasticity):
    def edit(self, spec: mujoco.MjSpec) -> None:
        super().edit(spec)
        gear = spec.joint(f"{self.where}/play")
        wound = max(self.scales.force[self.where] / gear.stiffness[0], 1e-12)  # where the slope is 1 + HARDENING times
        gear.stiffness[2] = HARDENING / 3 * gear.stiffness[0] / wound**2


class OwnCogging(Cogging):
    def force(self, plant: Simulated) -> None:
        super().force(plant)
        q = plant.data.qpos[plant.address(self.joint)]
        second = SECOND * self.size * math.sin(2 * (self.count * q + self.phase))
        plant.data.qfrc_applied[plant.dof(self.joint)] += second


_OWN: Sequence[type[Cause]] = (
    OwnCoulomb, OwnStribeck, OwnLoad, OwnAsymmetric, OwnBacklash, OwnElasticity, OwnCogging,
)  # fmt: skip
LATER = 3  # turns, of the first effect of a double
LAWS = {law.name: law for law in _OWN}


def lawful(cause: Cause) -> Cause:
    """The cause as it was drawn, under its law of these; one that has none, as it is."""
    if cause.name not in LAWS:
        return cause
    own = object.__new__(LAWS[cause.name])
    vars(own).update(vars(cause))
    return own


def turn(kind: str, system: str, seed: int, effects: tuple[str, ...]) -> tuple[str, ...]:
    """The effects of a case that was drawn as one of a data sheet, where laws of these take turns."""
    turns = [str(name) for name in np.random.default_rng([*system.encode()]).permutation([*LAWS])]
    if kind == "single":
        return (turns[seed % len(turns)],)
    if kind != "double":
        return effects
    first = turns[(seed + LATER) % len(turns)]
    return first, next(e for e in effects if e != first and {e, first} != SECOND_BODY)
