"""Causes in the air or water around a body that floats freely."""

import mujoco
import numpy as np

from bayessim_mjx.blind.reality.cause import Cause, Simulated

SLOW = 3.0  # m/s at which drag of the largest size is as large as the body's weight; a rule of thumb


class BodyDrag(Cause):
    """Still air or water that slows a body down, in any direction alike; the size is the force per speed.

    In one case of two it grows with the speed, in one of two the body's turns are slowed down as well.
    """

    name = "body_drag"
    kind = "body"
    stepped = True
    still: tuple[float, ...] = (0.0, 0.0, 0.0)  # velocity of the medium
    axes: tuple[float, ...] = (1.0, 1.0, 1.0)  # factors along the body's axes

    def draw(self, rng: np.random.Generator) -> None:
        self.growth, self.turns = (float(x) for x in rng.uniform(size=2) < 0.5)  # 1/(m/s); m^2 times a hundred
        self.largest = 9.81 * self.scales.mass[self.where] / SLOW

    def force(self, plant: Simulated) -> None:
        body, v = plant.model.body(self.where).id, np.zeros(6)
        mujoco.mj_objectVelocity(plant.model, plant.data, mujoco.mjtObj.mjOBJ_BODY, body, v, 0)  # of the centre of mass
        along, frame = v[3:] - np.array(self.still), plant.data.xmat[body].reshape(3, 3)
        push = self.size * (1 + self.growth * np.linalg.norm(along)) * (frame @ (self.axes * (frame.T @ along)))
        plant.data.xfrc_applied[body, :3] -= push
        plant.data.xfrc_applied[body, 3:] -= 0.01 * self.turns * self.size * v[:3]

    def parameters(self) -> dict[str, float]:
        own = {"linear": self.size, "quadratic": self.growth * self.size, "turning": 0.01 * self.turns * self.size}
        return {name: float(value) for name, value in own.items()}


class DirectionalDrag(BodyDrag):
    """Drag that differs by the body's axes."""

    name = "directional_drag"

    def draw(self, rng: np.random.Generator) -> None:
        super().draw(rng)
        self.axes = (1.0, *(float(x) for x in np.exp(rng.uniform(-1.2, 1.2, 2))))

    def parameters(self) -> dict[str, float]:
        return super().parameters() | {"side": self.axes[1], "up": self.axes[2]}


class Wind(BodyDrag):
    """The same in air or water that moves at up to three metres per second."""

    name = "wind"

    def draw(self, rng: np.random.Generator) -> None:
        super().draw(rng)
        heading, speed = rng.uniform(0, 2 * np.pi), rng.uniform(0.5, 3.0)
        self.still = (float(speed * np.cos(heading)), float(speed * np.sin(heading)), 0.0)

    def parameters(self) -> dict[str, float]:
        return super().parameters() | dict(zip(("wind_x", "wind_y", "wind_z"), self.still, strict=True))
