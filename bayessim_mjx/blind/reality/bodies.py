"""Causes in what links weigh, in what carries them, and in the ground below."""

from collections.abc import Iterator, Sequence

import mujoco
import numpy as np

from bayessim_mjx.blind.reality.cause import Cause, Simulated


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


# What a model consists of: links, whether and about which axis they turn; and ground that can be touched


def turns(model: mujoco.MjModel, body: int) -> bool:
    """Whether a body with joints of its own and mass is turned, alone or with those before it."""
    diagonal = model.body_dofnum[body] > 1 and model.body_simple[body] == 1  # compiled so: no other inertia is taken
    if model.body_weldid[body] != body or model.body_mass[body] <= 0 or diagonal:
        return False
    while body:
        first, count = model.body_jntadr[body], model.body_jntnum[body]
        if any(int(k) != int(mujoco.mjtJoint.mjJNT_SLIDE) for k in model.jnt_type[first : first + count]):
            return True
        body = int(model.body_parentid[body])
    return False


def length(model: mujoco.MjModel, body: int) -> float:
    """m, of a rod of the same mass and largest inertia: m l^2 / 12."""
    return float(np.sqrt(12 * model.body_inertia[body].max() / model.body_mass[body]))


def axis(model: mujoco.MjModel, body: int) -> np.ndarray:
    """`[3]`, of the one hinge that a body has, in its frame; zeros where it has none, or several."""
    own = range(model.body_jntadr[body], model.body_jntadr[body] + model.body_jntnum[body])
    hinges = [i for i in own if int(model.jnt_type[i]) == int(mujoco.mjtJoint.mjJNT_HINGE)]
    return model.jnt_axis[hinges[0]].copy() if len(hinges) == 1 else np.zeros(3)


def chain(model: mujoco.MjModel, joints: Sequence[str]) -> dict[str, tuple[str, str]]:
    """(joint before, first joint behind) of each; a joint of another kind in between parts them."""
    before: dict[str, str] = {}
    for name in joints:
        at = model.joint(name).id
        body = int(model.jnt_bodyid[at])
        way = [i for i in range(model.body_jntadr[body], at)]  # those of its own body that come first
        while not way and body:
            body = int(model.body_parentid[body])
            way = list(range(model.body_jntadr[body], model.body_jntadr[body] + model.body_jntnum[body]))
        last = model.joint(way[-1]).name if way else ""
        before[name] = last if last in joints else ""
    behind = {other: name for name, other in reversed(before.items()) if other}
    return {name: (before[name], behind.get(name, "")) for name in joints}


def ground(spec: mujoco.MjSpec) -> list[mujoco.MjsGeom]:
    """Geoms that can be touched and that no joint moves, but for those of a body that carries joints."""
    if int(spec.option.disableflags) & int(mujoco.mjtDisableBit.mjDSBL_CONTACT):
        return []
    paired = {name for pair in spec.pairs for name in (pair.geomname1, pair.geomname2)}
    every = [*spec.worldbody.geoms, *(g for body in spec.worldbody.bodies for g in _still(body))]
    return [g for g in every if g.contype or g.conaffinity or (g.name and g.name in paired)]


def _still(body: mujoco.MjsBody) -> Iterator[mujoco.MjsGeom]:
    if body.joints or body.mocap:
        return
    if not _carries(body):
        yield from body.geoms
    for child in body.bodies:
        yield from _still(child)


def _carries(body: mujoco.MjsBody) -> bool:
    return bool(body.joints) or any(_carries(child) for child in body.bodies)


def lift(spec: mujoco.MjSpec, geoms: Sequence[mujoco.MjsGeom], way: np.ndarray) -> None:
    """Move geoms by `way` in the world, however bodies and frames above them are turned."""
    was = [(np.array(g.pos), np.array(g.fromto)) for g in geoms]

    def put(ways: np.ndarray) -> None:
        for g, (pos, ends), own in zip(geoms, was, ways, strict=True):
            g.pos, g.fromto = pos + own, ends + np.tile(own, 2)  # the second one is NaN where it is not used

    before, axes = _places(spec, geoms), []
    for unit in np.eye(3):
        put(np.tile(unit, (len(geoms), 1)))
        axes.append(_places(spec, geoms) - before)
    put(np.einsum("knw,w->nk", np.array(axes), way))  # the axes are those of a rotation


def _places(spec: mujoco.MjSpec, geoms: Sequence[mujoco.MjsGeom]) -> np.ndarray:
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    return np.array([data.geom_xpos[g.id] for g in geoms])


# Causes in the air or water around a body that floats freely


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
