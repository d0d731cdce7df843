"""ShadowHand: a hand turns a cube to one goal after another (IsaacGymEnvs' ShadowHand; model in shadow_hand.xml).

Unlike the original: quaternions in observations have w >= 0, as q and -q are one orientation. The palm is made of
capsules. Forces of joints are those of their drives. Pushes (`env.forceScale`) act on the cube as one impulse at the
beginning of a step. Tendons pull the last joint of a finger along by a constraint, firmer than Isaac's spring.
A cube that lies still on the palm's edge in MuJoCo C rocks by about a degree in MJX, which meets a box and a capsule in
other points.
"""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from bayessim_mjx.env import Observations
from bayessim_mjx.errors import UserError
from bayessim_mjx.frames import conjugate, product, rotation, xyzw
from bayessim_mjx.physics import World, mjx
from bayessim_mjx.physics.warp import wrenches
from bayessim_mjx.tasks._terms import told
from bayessim_mjx.tasks.manipulation import Manipulation

FINGERS = ("FF", "MF", "RF", "LF")
JOINTS = (
    *("WRJ1", "WRJ0"),
    *(f"{finger}J{i}" for finger in FINGERS[:3] for i in (3, 2, 1, 0)),
    *(f"LFJ{i}" for i in (4, 3, 2, 1, 0)),
    *(f"THJ{i}" for i in (4, 3, 2, 1, 0)),
)
ACTIONS = tuple(joint for joint in JOINTS if joint not in ("FFJ0", "MFJ0", "RFJ0", "LFJ0"))
TIPS = ("ffdistal", "mfdistal", "rfdistal", "lfdistal", "thdistal")
HAND, CUBE = slice(0, 24), slice(24, 27)  # of qpos and qvel
TURN, SPIN = slice(27, 31), slice(27, 30)  # of the cube: in qpos, in qvel

HEIGHT = {"isaacgymenvs": 0.10, "bayessim2021": 0.04}  # m, of the cube above the hand at the start
DROP = 0.04  # m, from there to the goal
SHOWN = np.array([-0.2, -0.06, 0.12])  # m, from the goal to where pictures show it
PLACE_NOISE, JOINT_NOISE = 0.01, 0.2  # m; share of the joints' ranges
FALLEN = 0.24  # m from the goal
DECAY, DECAY_TIME = 0.99, 0.08  # of pushes: by this share in this time, s
SPEED_SCALE, FORCE_SCALE = 0.2, 10.0

_XYZ = tuple("xyz")
_POSE = (*_XYZ, *(f"quaternion_{i}" for i in "xyzw"))


def _labels(subject: str, parts: Sequence[str]) -> tuple[str, ...]:
    return tuple(f"{subject}_{part}" for part in parts)


PARTS: dict[str, tuple[str, ...]] = {  # of observations, and the names of their numbers
    "joints": tuple(f"{joint}_position" for joint in JOINTS),
    "speeds": tuple(f"{joint}_velocity" for joint in JOINTS),
    "torques": tuple(f"{joint}_torque" for joint in JOINTS),
    "cube_place": _labels("cube", _XYZ),
    "cube": _labels("cube", _POSE),
    "cube_motion": (*_labels("cube_velocity", _XYZ), *_labels("cube_angular_velocity", _XYZ)),
    "goal": _labels("goal", _POSE),
    "turn": _labels("cube_from_goal", _POSE[3:]),
    "tips": tuple(name for tip in TIPS for name in _labels(tip, _XYZ)),
    "tip_states": tuple(
        name
        for tip in TIPS
        for name in (
            *_labels(tip, _POSE),
            *_labels(f"{tip}_velocity", _XYZ),
            *_labels(f"{tip}_angular_velocity", _XYZ),
        )
    ),
    "loads": tuple(name for tip in TIPS for kind in ("force", "moment") for name in _labels(f"{tip}_{kind}", _XYZ)),
    "actions": tuple(f"{joint}_action" for joint in ACTIONS),
}
TYPES: dict[str, tuple[str, ...]] = {
    "full_state": (
        *("joints", "speeds", "torques", "cube", "cube_motion", "goal", "turn", "tip_states", "loads", "actions"),
    ),
    "full": ("joints", "speeds", "cube", "cube_motion", "goal", "turn", "tip_states", "actions"),
    "full_no_vel": ("joints", "cube", "goal", "turn", "tips", "actions"),
    "openai": ("tips", "cube_place", "turn", "actions"),
}


def _names(kind: str) -> tuple[str, ...]:
    return tuple(name for part in TYPES[kind] for name in PARTS[part])


ALLOWED: Mapping[str, tuple[Callable[[Any], bool], str]] = {
    "observationType": (lambda x: x in TYPES, ", ".join(TYPES)),
    "dofSpeedScale": (lambda x: x > 0, "numbers above 0"),
    "actionsMovingAverage": (lambda x: 0 < x <= 1, "numbers above 0, at most 1"),
    "successTolerance": (lambda x: x > 0, "angles above 0, rad"),
    "forceScale": (lambda x: x >= 0, "numbers from 0 on"),
    "forceProbRange": (lambda x: len(x) == 2 and 0 < x[0] <= x[1] <= 1, "[least, most], above 0 and at most 1"),
}


class ShadowHand(Manipulation):
    """211 observations (157, 77 or 42 with another `env.observationType`): see TYPES and PARTS; world axes, m, rad, s.

    Joints are from -1 to 1 within their limits; their speeds and the cube's turning are x 0.2, drives' torques and the
    fingertips' contact forces and moments (own axes) x 10. Actions: places of the drives within their ranges.
    """

    control_dt: ClassVar[float] = 1 / 60
    default_episode_length: ClassVar[int] = 600
    options: ClassVar[dict[str, Any]] = {
        "observationType": "full_state",
        "asymmetric_observations": False,  # a critic of its own that sees full_state
        "useRelativeControl": False,  # actions are rates of targets instead
        "dofSpeedScale": 20.0,  # rad/s, of these
        "actionsMovingAverage": 1.0,
        "successTolerance": 0.1,  # rad
        "fallPenalty": 0.0,
        "forceScale": 0.0,  # m/s^2, standard deviation of pushes
        "forceProbRange": (0.001, 0.1),  # of a push in a step
    }
    observation_clip: ClassVar[dict[str, float | None]] = {"isaacgymenvs": 5.0, "bayessim2021": 100.0}
    observation_names: ClassVar[tuple[str, ...]] = _names("full_state")
    zeros: ClassVar[dict[str, float]] = {"stiffness": 0.1}  # N m/rad, as in BayesSimIG (ig_env_wrappers.py)

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        for name, (allowed, words) in ALLOWED.items():
            _check(name, self.settings[name], allowed, words)
        self.observation_names = _names(self.settings["observationType"])  # type: ignore[misc]
        self.smoothing = self.settings["actionsMovingAverage"]  # type: ignore[misc]
        if self.settings["useRelativeControl"]:
            self.rates = (self.settings["dofSpeedScale"],) * self.mj_model.nu  # type: ignore[misc]
        self._tips = np.array([self.mj_model.body(tip).id for tip in TIPS])
        self._root = int(self.mj_model.body("hand").id)
        self.goal_place = np.float32(self._start - [0, 0, DROP])

    def spec(self) -> mujoco.MjSpec:
        return mujoco.MjSpec.from_file(str(Path(__file__).with_name("shadow_hand.xml")))

    # Starts and goals.

    @property
    def _start(self) -> np.ndarray:
        """Where the cube starts, m."""
        return self.mj_model.body("hand").pos + [0, -0.39, HEIGHT[self.variant]]

    def initial(self, key: jax.Array) -> tuple[jax.Array, jax.Array]:
        key_joints, key_place, key_turn = jax.random.split(key, 3)
        low, high = self.mj_model.jnt_range[HAND].T.astype(np.float32)
        least = -1.0 if self.variant == "bayessim2021" else 0.0  # the original of 2021 also draws beyond the limits
        joints = low + (high - low) * jax.random.uniform(key_joints, (24,), minval=least)
        place = self._start + PLACE_NOISE * jax.random.uniform(key_place, (3,), minval=-1.0)
        return jnp.concatenate([JOINT_NOISE * joints, place, _random_turn(key_turn)]), jnp.zeros(self.mj_model.nv)

    def start(self, key: jax.Array, world: World) -> dict[str, Any]:
        key_goal, key_chance, key = jax.random.split(key, 3)
        own = {"goal": _random_turn(key_goal), "reached": jnp.zeros((), bool), "successes": jnp.zeros(()), "key": key}
        if self.settings["forceScale"]:
            least, most = np.log(self.settings["forceProbRange"]).astype(np.float32)
            chance = jnp.exp(jax.random.uniform(key_chance, (), minval=least, maxval=most))
            own |= {"push": jnp.zeros(3), "push_chance": chance}
        return super().start(key, world) | own

    def actuate(self, world: World, action: jax.Array) -> tuple[World, jax.Array]:
        world, command = super().actuate(world, action)
        key, key_goal, key_push = jax.random.split(world.task["key"], 3)
        goal = jnp.where(world.task["reached"], _random_turn(key_goal), world.task["goal"])
        world = world.replace(task=world.task | {"key": key, "goal": goal})
        return (self._pushed(world, key_push) if self.settings["forceScale"] else world), command

    def _pushed(self, world: World, key: jax.Array) -> World:
        """Push the cube in its own axes; the push fades until there is another."""
        key_when, key_how = jax.random.split(key)
        fresh = self.settings["forceScale"] * jax.random.normal(key_how, (3,))
        faded = DECAY ** (self.dt / DECAY_TIME) * world.task["push"]
        push = jnp.where(jax.random.uniform(key_when) < world.task["push_chance"], fresh, faded)
        qvel = world.qvel.at[24:27].add(self.dt * rotation(world.qpos[TURN]) @ push)
        return world.replace(qvel=qvel, task=world.task | {"push": push})

    def advance(self, before: World, world: World, data: mjx.Data, action: jax.Array) -> World:
        reached = _angle(world.qpos[TURN], world.task["goal"]) <= self.settings["successTolerance"]
        return world.replace(
            task=world.task | {"reached": reached, "successes": world.task["successes"] + reached.astype(jnp.float32)}
        )

    def marks(self, qpos: np.ndarray, observation: np.ndarray) -> np.ndarray:
        """Mark a cube beside the hand in the goal's orientation: that of the cube, turned back by how they differ."""
        between = [self.observation_names.index(f"cube_from_goal_quaternion_{i}") for i in "wxyz"]
        goal = jax.vmap(lambda turn, cube: product(conjugate(turn), cube))(observation[:, between], qpos[:, TURN])
        place = np.broadcast_to(self.goal_place + SHOWN, (len(qpos), 3))
        return np.concatenate([place, np.asarray(goal)], axis=1)[:, None]

    # What is seen and paid.

    def observe(self, world: World, data: mjx.Data, action: jax.Array) -> Observations:
        kinds = {"policy": self.settings["observationType"]}
        if self.settings["asymmetric_observations"]:
            kinds["critic"] = "full_state"
        wanted = {part for kind in kinds.values() for part in TYPES[kind]}
        parts = self._seen(world) | {"actions": action}
        if "loads" in wanted:
            parts |= {"torques": FORCE_SCALE * data.qfrc_actuator[HAND], "loads": FORCE_SCALE * self._loads(data)}
        return {group: jnp.concatenate([parts[part] for part in TYPES[kind]]) for group, kind in kinds.items()}

    def _seen(self, world: World) -> dict[str, jax.Array]:
        """Return the parts of observations that the sensors' positions and speeds give."""
        qpos, qvel = world.measurement["qpos"], world.measurement["qvel"]
        low, high = self.mj_model.jnt_range[HAND].T.astype(np.float32)
        place, turn, goal = qpos[CUBE], qpos[TURN], world.task["goal"]
        spin = rotation(turn) @ qvel[SPIN]  # MuJoCo has it in the cube's axes
        states = self._tip_states(world)
        return {
            "joints": (2 * qpos[HAND] - high - low) / (high - low),
            "speeds": SPEED_SCALE * qvel[HAND],
            "cube_place": place,
            "cube": jnp.concatenate([place, _positive(turn)]),
            "cube_motion": jnp.concatenate([qvel[CUBE], SPEED_SCALE * spin]),
            "goal": jnp.concatenate([self.goal_place, _positive(goal)]),
            "turn": _positive(product(turn, conjugate(goal))),
            "tips": states[:, :3].ravel(),
            "tip_states": states.ravel(),
        }

    def _tip_states(self, world: World) -> jax.Array:
        """`[5, 13]` place, quaternion, velocity and turning of the last links, where the sensors say that they are."""
        shown = world.replace(qpos=world.measurement["qpos"], qvel=world.measurement["qvel"])
        data, tips = self.physics.kinematics(shown), self._tips
        place, spin = data.xpos[tips], data.cvel[tips, :3]
        velocity = data.cvel[tips, 3:] + jnp.cross(spin, place - data.subtree_com[self._root])
        return jnp.concatenate([place, jax.vmap(_positive)(data.xquat[tips]), velocity, spin], axis=1)

    def _loads(self, data: mjx.Data) -> jax.Array:
        """`[30]` contacts' forces on the last links and their moments about the links' origins (N, N m; own axes)."""
        wrench, turn, tips = wrenches(self.sys, data), data.xmat[self._tips], self._tips
        arm = data.subtree_com[self._root] - data.xpos[tips]
        force = wrench[tips, 3:]
        moment = wrench[tips, :3] + jnp.cross(arm, force)
        return jnp.concatenate([jnp.einsum("ni,nij->nj", x, turn) for x in (force, moment)], axis=1).ravel()

    def reward(
        self, before: World, after: World, data: mjx.Data, action: jax.Array
    ) -> tuple[jax.Array, jax.Array, dict[str, jax.Array]]:
        distance = jnp.linalg.norm(after.qpos[CUBE] - self.goal_place)
        angle = _angle(after.qpos[TURN], after.task["goal"])
        fallen = distance >= FALLEN
        reward = -10 * distance + 1 / (angle + 0.1) - 0.0002 * jnp.sum(action**2)
        reward += 250 * after.task["reached"] + self.settings["fallPenalty"] * fallen
        parts = {"distance": -10 * distance, "angle": 1 / (angle + 0.1), "actions": -0.0002 * jnp.sum(action**2)}
        parts |= {"goals": 250 * after.task["reached"], "fall": self.settings["fallPenalty"] * fallen}
        metrics = {"consecutive_successes": after.task["successes"], "goal_angle": angle}
        return reward, fallen, metrics | told(parts)


def _random_turn(key: jax.Array) -> jax.Array:
    """Draw a quaternion: about y and then about x, each by up to half a turn; these are not all orientations alike."""
    x, y = jnp.pi / 2 * jax.random.uniform(key, (2,), minval=-1.0)
    about_x = jnp.array([jnp.cos(x), jnp.sin(x), 0.0, 0.0])
    return product(about_x, jnp.array([jnp.cos(y), 0.0, jnp.sin(y), 0.0]))


def _positive(quat: jax.Array) -> jax.Array:
    """Return the quaternion in Isaac Gym's order, of the two that are one orientation that with w >= 0."""
    return xyzw(jnp.where(quat[0] < 0, -quat, quat))


def _angle(one: jax.Array, two: jax.Array) -> jax.Array:
    """Between two orientations, rad."""
    way = product(one, conjugate(two))[1:]
    return 2 * jnp.arcsin(jnp.minimum(jnp.sqrt(jnp.sum(way**2) + 1e-12), 1.0))


def _check(name: str, value: Any, allowed: Callable[[Any], bool], words: str) -> None:
    try:
        fine = allowed(value)
    except TypeError:
        fine = False
    if not fine:
        raise UserError(f"env.{name} = {value!r}: allowed are {words}")
