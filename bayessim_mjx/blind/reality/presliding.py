"""Dry friction that is a spring before it slips, by enough that encoders see it."""

import math

import mujoco
import numpy as np

from bayessim_mjx.blind.reality.cause import Past, Simulated
from bayessim_mjx.blind.reality.joints import STIFF, StribeckFriction


class LugreFriction(StribeckFriction):
    """Bristles that bend so far that it shows, as Canudas de Wit has them: their damping is the same at any speed."""

    name = "lugre_friction"
    tame = False

    def draw(self, rng: np.random.Generator) -> None:
        super().draw(rng)
        low, high = self.scales.travel[self.where]
        self.ratio = rng.uniform(1.0, 2.0)
        # of the bristles: the bend grows with the level. A fixed one would leave weak friction to the bristles' damping
        share = math.exp(rng.uniform(math.log(0.01), math.log(0.15)))
        self.stiffness = self.ratio * self.largest / (share * (high - low))

    def bend(self) -> float:
        stiffest = STIFF * self.scales.inertia[self.where] / self.scales.timestep**2
        return max(self.highest() / min(self.stiffness, stiffest), 1e-12)

    def reset(self, plant: Simulated, command: np.ndarray) -> None:
        super().reset(plant, command)
        self.fresh = True

    def command(self, plant: Simulated, u: np.ndarray) -> None:
        """Where nothing was seen before, bristles are bent as they are long after: sliding, or holding the load."""
        if not self.fresh:
            return
        self.fresh, data = False, plant.data
        data.ctrl[:] = u
        mujoco.mj_forward(plant.model, data)
        w, acceleration = float(data.qvel[self.dof]), float(data.qacc[self.dof])
        load = self.scales.inertia[self.where] * (w / plant.timestep + acceleration)
        most = self.level(plant, w)
        self.bristle.z = min(max(load, -most), most) / max(self.bristle.s0, 1e-300)

    def resume(self, plant: Simulated, past: Past) -> None:
        """Bristles as the motion has bent them; exact where speeds are constant between rows."""
        self.fresh, at = len(past.q) < 2, past.q[:, plant.column(self.where)]
        for way, time in zip(np.diff(at), np.diff(past.time), strict=True):
            steady = self.level(plant, float(way / time)) / max(self.bristle.s0, 1e-300)
            keep = math.exp(-abs(float(way)) / max(steady, 1e-300))
            self.bristle.z = keep * self.bristle.z + (1 - keep) * math.copysign(steady, way)

    def parameters(self) -> dict[str, float]:
        return super().parameters() | {"bend": self.bend()}
