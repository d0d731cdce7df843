"""A compiled model with its parameters and effects, and the state of one world of it."""

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from flax import struct

from bayessim_mjx.compat import mjx
from bayessim_mjx.effects.effect import Block, Effect, Measurement, Quantity, layout, overrides
from bayessim_mjx.effects.support import contract
from bayessim_mjx.errors import UserError
from bayessim_mjx.keys import branch
from bayessim_mjx.parameters import ParameterSpace, constants
from bayessim_mjx.physics.gates import chained_in
from bayessim_mjx.physics.native import absent, own_forces
from bayessim_mjx.physics.warp import Warp

EULER, RK4, IMPLICITFAST = (int(getattr(mujoco.mjtIntegrator, f"mjINT_{n}")) for n in ("EULER", "RK4", "IMPLICITFAST"))
BRANCHES = 1000  # branches of a reset's key below are the tasks', those from it on the effects'; nothing else uses them
PARTS = 4  # of a timestep by RK4, in which commands may differ behind effects


class World(struct.PyTreeNode):
    """Everything the next control step of one world needs. Lean: no `mjx.Data`; `vmap` adds leading axes.

    Attributes:
        qpos: `[nq]`, qvel: `[nv]`, act: `[na]`; MuJoCo's state.
        warmstart: `[nv]`, the last acceleration, where the constraint solver starts.
        time: `[]`, s.
        theta: `[d]`, the values of `physics.space` that hold in this episode.
        fields: model arrays that differ from the nominal ones, by dotted name (computed at reset, constant afterwards).
        memory: one pytree per effect.
        forces: `[effects, nv]`, each effect's generalised force in the last sub-step.
        measurement: `{"qpos", "qvel"}` as the sensors show them; equal to qpos, qvel unless an effect says otherwise.
        task: numbers a task carries along (commands, counters); physics does not read them.
    """

    qpos: jax.Array
    qvel: jax.Array
    act: jax.Array
    warmstart: jax.Array
    time: jax.Array
    theta: jax.Array
    fields: dict[str, jax.Array]
    memory: tuple
    forces: jax.Array
    measurement: dict[str, jax.Array]
    task: dict[str, Any] = struct.field(default_factory=dict)


class Physics:
    """A compiled model with its parameters and effects. Immutable and hashable by identity: static under `jit`.

    Attributes:
        blocks: the layout of theta: the model's parameters, then those of each effect at each of its places.
        space: all of them; model_space: the model's.

    Args:
        mj_model: the nominal MuJoCo model.
        control_dt: control step, s; a whole multiple of the model's timestep.
        space: parameters written into the model.
        effects: effects in the order in which their hooks are called.
        max_qvel: `[nv]` or scalar; velocities are clipped to +-max_qvel after each sub-step (the position has moved
            with the unclipped one). None: no clipping.
        impl: what computes a timestep: MJX's stages in "jax", or all of it in "warp"; see `warp.Warp`.
        unroll: a control step's timesteps stand in a row in the program, in place of a loop.

    Raises:
        ValueError: if control_dt is no multiple of the timestep, the integrator is unknown to MJX, or an effect's
            `where` is not in the model.
    """

    def __init__(
        self,
        mj_model: mujoco.MjModel,
        control_dt: float,
        space: ParameterSpace,
        effects: Sequence[Effect] = (),
        max_qvel: float | Sequence[float] | None = None,
        impl: str = "jax",
        unroll: bool = False,
    ) -> None:
        self.mj_model = mj_model
        if why := absent(mj_model):
            raise UserError(f"MJX does not simulate {why}")
        self.effects = (*effects, *own_forces(mj_model))
        self.model_space = space
        self.blocks = layout(space, self.effects)
        self.space = ParameterSpace(p for block in self.blocks for p in block.parameters)
        self._slices = tuple(slice(own[0].start, own[-1].stop) for own in map(self.blocks_of, self.effects))
        self.substeps = _substeps(control_dt, mj_model.opt.timestep)
        self.unroll = unroll
        self.dt = float(self.substeps * mj_model.opt.timestep)
        if int(mj_model.opt.integrator) not in (EULER, RK4, IMPLICITFAST):
            raise UserError(f"integrator {mj_model.opt.integrator}: MJX has Euler, RK4 and implicitfast")
        self.max_qvel = None if max_qvel is None else np.broadcast_to(np.asarray(max_qvel, np.float32), (mj_model.nv,))
        here = jax.local_devices()[0]  # MJX would take the first of all, which may be another process's
        self.model = mjx.put_model(mj_model, here, "jax")
        self.template = mjx.make_data(mj_model, here, "jax")
        self.warp = Warp(mj_model, self.template, self.effects) if impl == "warp" else None
        timestep = float(mj_model.opt.timestep)
        for effect in filter(contract.brought, self.effects):
            contract.check(effect, mj_model, self.model, self.substeps)
        divided = int(mj_model.opt.integrator) == RK4 and self.having("on_command")
        self.rows = PARTS if divided else 1  # of commands in a timestep, as effects see them
        between = timestep / self.rows, self.substeps * self.rows
        self.sites = tuple(effect.bind(mj_model, *between) for effect in self.effects)
        self._memory = tuple(effect.init(at) for effect, at in zip(self.effects, self.sites, strict=True))

    def split(self, theta: jax.Array) -> tuple[jax.Array, tuple[jax.Array, ...]]:
        """(values of the model's parameters, one slice per effect)."""
        return theta[self.blocks[0].slice], tuple(theta[own] for own in self._slices)

    def blocks_of(self, effect: Effect) -> tuple[Block, ...]:
        """Those of one of `effects`, one per place."""
        return tuple(block for block in self.blocks if block.effect is effect)

    def quantity(self, index: int) -> Quantity:
        """Return the quantity of its effect for the number at `index` of theta."""
        return next(b.quantities[index - b.start] for b in self.blocks if b.start <= index < b.stop)

    @property
    def neutral(self) -> np.ndarray:
        """theta `[d]` with all effects off, the model's parameters nominal."""
        return np.asarray([value for block in self.blocks for value in block.neutral], np.float32)

    def acting(self, thetas: np.ndarray) -> np.ndarray:
        """`[n, effects]`, whether an effect has a number that is not neutral (or none at all), of thetas `[n, d]`."""
        moved = np.asarray(thetas, np.float32) != self.neutral
        each = [moved[:, own].any(1) if moved[:, own].size else np.ones(len(moved), bool) for own in self._slices]
        return np.stack(each, 1) if each else moved[:, :0]

    def world(
        self,
        theta: jax.Array,
        qpos: jax.Array | None = None,
        qvel: jax.Array | None = None,
        key: jax.Array | None = None,
    ) -> World:
        """Begin a world at the start of an episode, as the sensors show it at rest; writes `theta` into the model once.

        Args:
            theta: `[d]`, values of `self.space`.
            qpos: `[nq]`, default the model's qpos0.
            qvel: `[nv]`, default zero.
            key: of what effects draw in the episode (`Effect.random`); None: always the same.

        Raises:
            ValueError: on a wrong shape.
        """
        with jax.default_matmul_precision("highest"):
            world = self.unseen(theta, qpos, qvel)
            started = world.memory if key is None else self._seeded(world.memory, key)
            memory, shown = self.sense(self.split(world.theta)[1], started, world.measurement)
            return world.replace(memory=memory, measurement=shown)

    def _seeded(self, memory: tuple, key: jax.Array) -> tuple:
        """Return the effects' memories with keys of their own for those that draw at random."""
        each = enumerate(zip(self.effects, memory, strict=True))
        return tuple(own | {"key": branch(key, BRANCHES + i)} if effect.random else own for i, (effect, own) in each)

    def unseen(
        self,
        theta: jax.Array,
        qpos: jax.Array | None,
        qvel: jax.Array | None,
        fields: dict[str, jax.Array] | None = None,
    ) -> World:
        """`world` without sensors: they have not measured yet; fields: those of theta, where they are known."""
        theta = jnp.asarray(theta, jnp.float32)
        qpos = jnp.asarray(self.mj_model.qpos0 if qpos is None else qpos, jnp.float32)
        qvel = jnp.zeros(self.mj_model.nv) if qvel is None else jnp.asarray(qvel, jnp.float32)
        for label, value, size in (
            ("theta", theta, len(self.space)),
            ("qpos", qpos, self.mj_model.nq),
            ("qvel", qvel, self.mj_model.nv),
        ):
            if value.shape != (size,):
                raise ValueError(f"{label} has shape {value.shape}, expected ({size},)")
        return World(
            qpos=qpos,
            qvel=qvel,
            act=jnp.zeros(self.mj_model.na),
            warmstart=jnp.zeros(self.mj_model.nv),
            time=jnp.zeros(()),
            theta=theta,
            fields=self._fields(*self.split(theta)) if fields is None else fields,
            memory=self._memory,
            forces=jnp.zeros((len(self.effects), self.mj_model.nv)),
            measurement={"qpos": qpos, "qvel": qvel},
        )

    def _fields(self, own: jax.Array, slices: tuple[jax.Array, ...]) -> dict[str, jax.Array]:
        """Model arrays that differ from the nominal ones, with the model's parameters and every effect's written."""
        model = self.model_space.write(self.model, own, derived=False)
        each = list(zip(self.effects, self.sites, slices, strict=True))
        for effect, at, part in (one for one in each if one[0].inertial):
            model = effect.on_model(at, model, part)
        model = model.tree_replace(constants.renewed(self.model, _changed(self.model, model)))
        for effect, at, part in (one for one in each if not one[0].inertial):
            model = effect.on_model(at, model, part)
        return _changed(self.model, model)

    def sense(
        self, thetas: tuple, memory: Sequence[Any], true: Measurement, active: jax.Array | None = None
    ) -> tuple[tuple, Measurement]:
        """(effects' memories, what the sensors show) of the true {"qpos", "qvel"}; thetas: one slice per effect."""

        def hook(i: int, remembered: Any, shown: Measurement) -> tuple[Any, Measurement]:
            return self.effects[i].on_measurement(self.sites[i], remembered, shown, thetas[i])

        return chained_in(active, self.having("on_measurement"), hook, memory, true)

    def having(self, hook: str) -> list[int]:
        """Return indices of the effects that have this hook."""
        return [i for i, effect in enumerate(self.effects) if overrides(effect, hook)]

    def encoders(
        self, thetas: tuple, memory: tuple, qpos: jax.Array, qvel: jax.Array, active: jax.Array | None = None
    ) -> tuple[jax.Array, jax.Array]:
        """(qpos, qvel) as the joints' own encoders show them to their drives: with the sensors' static errors.

        Delays and filters lie between the drive and whoever records; without a past they show what is. memory: of the
        effects, which says where motors stand beside their links.
        """
        each = zip(self.effects, memory, self._memory, strict=True)
        now = tuple(new if effect.follows else old for effect, new, old in each)
        shown = self.sense(thetas, now, {"qpos": qpos, "qvel": qvel}, active)[1]
        return shown["qpos"], shown["qvel"]

    def model_of(self, world: World) -> mjx.Model:
        """Return the model with this world's parameters."""
        return self.model.tree_replace(world.fields) if world.fields else self.model

    def data_of(self, world: World) -> mjx.Data:
        """`mjx.Data` in this world's state; everything derived from the state is the template's (not this state's)."""
        return self.template.replace(**state_of(world))

    def kinematics(self, world: World) -> mjx.Data:
        """`mjx.Data` with the poses and velocities of all bodies in this world's state; no contacts, no forces."""
        return _poses(self.model_of(world), self.data_of(world))


def state_of(world: World) -> dict[str, jax.Array]:
    """MuJoCo's state, by the names of `mjx.Data`."""
    own = {"qpos": world.qpos, "qvel": world.qvel, "act": world.act, "time": world.time}
    return own | {"qacc_warmstart": world.warmstart}


@jax.jit  # a reset outside of any program would compile hundreds
def _poses(model: mjx.Model, data: mjx.Data) -> mjx.Data:
    return mjx.com_vel(model, mjx.com_pos(model, mjx.kinematics(model, data)))


def _substeps(control_dt: float, timestep: float) -> int:
    count = round(control_dt / timestep)
    if count < 1 or abs(count * timestep - control_dt) > 1e-6 * control_dt:
        raise UserError(f"control step {control_dt} s is no whole multiple of the model's timestep {timestep} s")
    return count


def _changed(nominal: mjx.Model, model: mjx.Model) -> dict[str, jax.Array]:
    """Leaves of `model` that are not the nominal objects, by dotted name."""
    before, _ = jax.tree_util.tree_flatten_with_path(nominal)
    after = jax.tree.leaves(model)
    if jax.tree.structure(nominal) != jax.tree.structure(model):  # type: ignore[operator]  # jaxlib's stubs
        raise UserError("an effect or parameter changed the structure of the model; only array values may change")
    pairs = zip(before, after, strict=True)
    return {_dotted(path): new for (path, old), new in pairs if new is not old}


def _dotted(path: Sequence[Any]) -> str:
    return jax.tree_util.keystr(tuple(path), simple=True, separator=".")
