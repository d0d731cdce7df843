"""Causes in what links weigh, in what carries them, and in the ground below."""

import mujoco
import numpy as np

from bayessim_mjx.blind.reality.cause import Cause, Simulated
from bayessim_mjx.blind.reality.links import ground, lift


class InertialParameters(Cause):
    """A link whose centre of mass lies elsewhere than its data sheet says, and whose inertia about it is another.

    The size is m of the shift, square to the link's own hinges, which would not feel the rest.
    """

    name = "inertial_parameters"
    kind = "body"

    def draw(self, rng: np.random.Generator) -> None:
        axis, way = self.scales.axis[self.where], rng.normal(size=3)
        way = way - axis * (axis @ way)
        self.direction, self.sign = way / np.linalg.norm(way), 1.0
        self.swell = rng.uniform(-0.4, 0.4)
        self.largest = 0.1 * self.scales.length[self.where]

    def edit(self, spec: mujoco.MjSpec) -> None:
        _state(spec)
        body = spec.body(self.where)
        body.ipos = np.array(body.ipos) + self.shift
        body.inertia = np.array(body.inertia) * self.factor

    @property
    def shift(self) -> np.ndarray:
        return self.sign * self.size * self.direction

    @property
    def factor(self) -> float:
        return 1 + self.swell * self.size / self.largest

    def parameters(self) -> dict[str, float]:
        return {f"com_{a}": float(x) for a, x in zip("xyz", self.shift, strict=True)} | {"inertia": self.factor}


def _state(spec: mujoco.MjSpec) -> None:
    """Write all inertials out as they are compiled, so that one of them can be changed."""
    model = spec.compile()
    spec.compiler.inertiafromgeom = mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_AUTO  # else it would take the geoms'
    for body in spec.bodies[1:]:
        body.explicitinertial, body.ialt.type = True, mujoco.mjtOrientation.mjORIENTATION_QUAT
        body.fullinertia = np.full(6, np.nan)
        body.mass, body.inertia = float(model.body_mass[body.id]), model.body_inertia[body.id]
        body.ipos, body.iquat = model.body_ipos[body.id], model.body_iquat[body.id]


class GravityCompensation(Cause):
    """Joints are held against a share of what all bodies weigh on them: MuJoCo's own force at rest, where they are."""

    name = "gravity_compensation"
    kind = "world"
    stepped = True
    model: mujoco.MjModel | None = None

    def draw(self, rng: np.random.Generator) -> None:
        self.sign = 1.0 if rng.uniform() < 0.75 else -1.0  # seldom a load that the robot is believed to carry
        self.largest = 1.2 if self.sign > 0 else 0.5

    def reset(self, plant: Simulated, command: np.ndarray) -> None:
        if self.model is not plant.model:
            self.model, self.still = plant.model, mujoco.MjData(plant.model)
            self.dofs = np.array([plant.dof(j) for j in self.scales.force], np.intp)
            self.weight = np.zeros(plant.model.nv)

    def force(self, plant: Simulated) -> None:
        self.still.qpos[:] = plant.data.qpos
        mujoco.mj_kinematics(plant.model, self.still)
        mujoco.mj_comPos(plant.model, self.still)
        mujoco.mj_rne(plant.model, self.still, 0, self.weight)
        plant.data.qfrc_applied[self.dofs] += self.sign * self.size * self.weight[self.dofs]

    def parameters(self) -> dict[str, float]:
        return {"share": self.sign * self.size}


class GroundHeight(Cause):
    """The ground is higher or lower: all that stands still and can be touched moves against gravity."""

    name = "ground_height"
    kind = "world"
    largest = 0.05

    def draw(self, rng: np.random.Generator) -> None:
        self.sign = float(rng.choice([-1, 1]))

    def edit(self, spec: mujoco.MjSpec) -> None:
        gravity = np.array(spec.option.gravity)
        size = float(np.linalg.norm(gravity))
        up = -gravity / size if size else np.array([0.0, 0.0, 1.0])
        lift(spec, ground(spec), self.sign * self.size * up)

    def parameters(self) -> dict[str, float]:
        return {"height": self.sign * self.size}
