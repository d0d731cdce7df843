"""Causes at bodies, the base and the sensors; and friction of joints that is a spring before it slips."""

import math
from collections import deque

import mujoco
import numpy as np

from bayessim_mjx.blind.reality.cause import Cause, Past, Simulated
from bayessim_mjx.blind.reality.joints import STIFF, StribeckFriction


class Payload(Cause):
    """A lump welded to the body, somewhere along it."""

    name = "payload"
    kind = "body"

    def draw(self, rng: np.random.Generator) -> None:
        self.share, self.aside = rng.uniform(0.2, 1.0), rng.uniform(-0.03, 0.03, 3)
        self.largest = 1.5 * self.scales.mass[self.where]

    def edit(self, spec: mujoco.MjSpec) -> None:
        body = spec.body(self.where)
        self.position = self.share * _end(body) + self.aside
        lump = body.add_body(name=f"{self.where}/payload", pos=self.position)
        lump.add_geom(
            type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[0.01, 0, 0], mass=max(self.size, 1e-9), contype=0, conaffinity=0
        )

    def parameters(self) -> dict[str, float]:
        x, y, z = self.position
        return {"mass": self.size, "x": x, "y": y, "z": z}


def _end(body: mujoco.MjsBody) -> np.ndarray:
    """Where a body ends: the far end of its first geom, or where that sits, or the centre of mass."""
    if not body.geoms:
        return np.nan_to_num(np.array(body.ipos))
    far = np.array(body.geoms[0].fromto[3:])
    return far if np.isfinite(far).all() else np.array(body.geoms[0].pos)


class GravityTilt(Cause):
    """The base does not stand level: gravity leans in the direction that the joints can feel."""

    name = "gravity_tilt"
    kind = "world"
    largest = 0.25

    def draw(self, rng: np.random.Generator) -> None:
        spread = 0.3 if len(self.scales.force) < 3 else np.pi
        self.heading = float(rng.choice([0, np.pi])) + rng.uniform(-spread, spread)

    def edit(self, spec: mujoco.MjSpec) -> None:
        g, lean = abs(float(spec.option.gravity[2])), self.size
        aside = g * math.sin(lean)
        spec.option.gravity = [aside * math.cos(self.heading), aside * math.sin(self.heading), -g * math.cos(lean)]

    def parameters(self) -> dict[str, float]:
        pitch = math.asin(math.sin(self.size) * math.cos(self.heading))
        roll = -math.asin(math.sin(self.size) * math.sin(self.heading) / math.cos(pitch))
        return {"roll": roll, "pitch": pitch}


class ExternalForce(Cause):
    """A constant force on a body in world axes (a spring balancer, wind), with gusts in one case of three."""

    name = "external_force"
    kind = "body"
    stepped = True

    def draw(self, rng: np.random.Generator) -> None:
        heading = rng.uniform(0, 2 * np.pi) if len(self.scales.force) >= 3 else float(rng.choice([0, np.pi]))
        self.direction = np.array([math.cos(heading), math.sin(heading), rng.uniform(-0.3, 0.3)])
        self.gusts = 0.4 if rng.uniform() < 1 / 3 else 0.0
        self.seed = int(rng.integers(2**31))
        self.largest = 3 * max(self.scales.force.values())

    def reset(self, plant: Simulated, command: np.ndarray) -> None:
        self.id, self.wind = plant.model.body(self.where).id, 0.0
        self.rng = np.random.default_rng(self.seed)

    def force(self, plant: Simulated) -> None:
        if self.gusts:  # Ornstein-Uhlenbeck of 0.5 s
            step = plant.timestep / 0.5
            self.wind += -self.wind * step + math.sqrt(2 * step) * self.rng.normal()
        plant.data.xfrc_applied[self.id, :3] += self.size * (1 + self.gusts * self.wind) * self.direction

    def parameters(self) -> dict[str, float]:
        return {f"force_{a}": float(self.size * x) for a, x in zip("xyz", self.direction, strict=True)}


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
        base = spec.body(self.scales.base)
        for name, axis in (("base/x", [1, 0, 0]), ("base/y", [0, 1, 0])):
            joint = base.add_joint(name=name, axis=axis, pos=[0, 0, -0.1], armature=0.1 * self.inertia)
            joint.stiffness[0], joint.damping[0] = k, 2 * self.zeta * math.sqrt(k * self.inertia)

    def reset(self, plant: Simulated, command: np.ndarray) -> None:
        """Before a run the mount carries the robot at rest."""
        model, data = plant.model, plant.data
        joints = [model.joint(name).id for name in ("base/x", "base/y")]
        for _ in range(10):  # each leaves the share of the spring's moment that the weight makes by its tilt
            mujoco.mj_forward(model, data)
            moment = data.qfrc_bias[model.jnt_dofadr[joints]]
            data.qpos[model.jnt_qposadr[joints]] = -moment / model.jnt_stiffness[joints]

    def parameters(self) -> dict[str, float]:
        return {"compliance": max(self.size, self.smallest)}


class ContactFriction(Cause):
    """MuJoCo's sliding friction of a geom, larger or smaller by a factor."""

    name = "contact_friction"
    kind = "geom"

    def draw(self, rng: np.random.Generator) -> None:
        self.sign = float(rng.choice([-1, 1]))
        self.largest = 4.0 if self.sign < 0 else 2.0

    def edit(self, spec: mujoco.MjSpec) -> None:
        geom = spec.geom(self.where)
        geom.friction = geom.friction * [self.factor, 1, 1]

    @property
    def factor(self) -> float:
        return (1 + self.size) ** self.sign

    def parameters(self) -> dict[str, float]:
        return {"scale": self.factor}


class ContactCompliance(Cause):
    """MuJoCo's time constant of a geom's contacts, longer by a factor."""

    name = "contact_compliance"
    kind = "geom"
    largest = 2.0

    def edit(self, spec: mujoco.MjSpec) -> None:
        geom = spec.geom(self.where)
        geom.solref = geom.solref * [math.exp(self.size), 1]

    def parameters(self) -> dict[str, float]:
        return {"softness": self.size}


class JointOffset(Cause):
    """The encoder's zero is wrong: everything that reads it, the servo included."""

    name = "joint_offset"
    largest = 0.15

    def draw(self, rng: np.random.Generator) -> None:
        self.sign = float(rng.choice([-1, 1]))

    def edit(self, spec: mujoco.MjSpec) -> None:
        own = [a for a, joint in self.scales.drives.items() if joint == self.where]
        for actuator in self.scales.servo.intersection(own):
            servo = spec.actuator(actuator)
            servo.biasprm[0] += servo.biasprm[1] * self.sign * self.size

    def sense(self, plant: Simulated, q: np.ndarray, v: np.ndarray) -> None:
        q[plant.column(self.where)] += self.sign * self.size

    def parameters(self) -> dict[str, float]:
        return {"offset": self.sign * self.size}


class SensorDelay(Cause):
    """Old readings: a buffer of true positions, interpolated."""

    name = "sensor_delay"
    stepped = True
    largest = 0.06

    def reset(self, plant: Simulated, command: np.ndarray) -> None:
        lag = self.size / plant.timestep
        self.whole, self.part = int(lag), lag - int(lag)
        self.buffer: deque[tuple[float, float]] = deque(maxlen=self.whole + 2)

    def watch(self, plant: Simulated, q: np.ndarray, v: np.ndarray) -> None:
        self.buffer.append((float(q[plant.column(self.where)]), float(v[plant.speed_column(self.where)])))

    def sense(self, plant: Simulated, q: np.ndarray, v: np.ndarray) -> None:
        i, j = plant.column(self.where), plant.speed_column(self.where)
        recent = self.buffer[max(len(self.buffer) - 1 - self.whole, 0)]
        older = self.buffer[max(len(self.buffer) - 2 - self.whole, 0)]
        q[i], v[j] = ((1 - self.part) * a + self.part * b for a, b in zip(recent, older, strict=True))

    def parameters(self) -> dict[str, float]:
        return {"delay": self.size}


class SensorFilter(Cause):
    """First-order low pass of the readings, exact per sub-step."""

    name = "sensor_filter"
    stepped = True
    largest = 0.08
    smallest = 1e-4

    def reset(self, plant: Simulated, command: np.ndarray) -> None:
        self.state: tuple[float, float] | None = None
        self.keep = math.exp(-plant.timestep / max(self.size, self.smallest))

    def watch(self, plant: Simulated, q: np.ndarray, v: np.ndarray) -> None:
        new = (float(q[plant.column(self.where)]), float(v[plant.speed_column(self.where)]))
        old = self.state or new
        self.state = tuple(self.keep * a + (1 - self.keep) * b for a, b in zip(old, new, strict=True))  # type: ignore[assignment]

    def sense(self, plant: Simulated, q: np.ndarray, v: np.ndarray) -> None:
        assert self.state
        q[plant.column(self.where)], v[plant.speed_column(self.where)] = self.state

    def parameters(self) -> dict[str, float]:
        return {"time_constant": self.size}


class SensorGain(Cause):
    name = "sensor_gain"
    largest = 0.2

    def draw(self, rng: np.random.Generator) -> None:
        self.sign = float(rng.choice([-1, 1]))

    def sense(self, plant: Simulated, q: np.ndarray, v: np.ndarray) -> None:
        q[plant.column(self.where)] *= 1 + self.sign * self.size
        v[plant.speed_column(self.where)] *= 1 + self.sign * self.size

    def parameters(self) -> dict[str, float]:
        return {"gain": 1 + self.sign * self.size}


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
