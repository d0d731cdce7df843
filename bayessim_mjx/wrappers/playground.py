"""Our tasks as environments of MuJoCo Playground: `register()`, then `registry.load("bayessim_mjx/Ant")`.

`make(task, domain)` gives one directly, for `wrap_for_brax_training`. With a domain each reset draws theta; Playground
repeats the first episode of each world unless it wraps with `full_reset=True`.
"""

from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
import mujoco

from bayessim_mjx.env import Env
from bayessim_mjx.env import State as OurState
from bayessim_mjx.errors import UserError
from bayessim_mjx.task_names import names
from bayessim_mjx.wrappers.fresh import Under
from bayessim_mjx.wrappers.worlds import environment

try:
    from ml_collections import config_dict
    from mujoco_playground._src import dm_control_suite, registry
    from mujoco_playground._src.mjx_env import MjxEnv, State
except ImportError as error:
    raise UserError(f"wrappers.playground needs it: pip install 'bayessim-mjx[playground]' ({error})") from error

PREFIX = "bayessim_mjx/"
OWN = ("ctrl_dt", "sim_dt", "episode_length", "action_repeat", "impl", "domain", "task")  # not settings of `env:`


def make(task: Any, domain: Any = None, **env_settings: Any) -> "PlaygroundEnv":
    """Make a task, or a run's task under its posterior (arguments as for `wrappers.worlds.worlds`)."""
    return PlaygroundEnv(Under(*environment(task, domain, env_settings)))


def register() -> tuple[str, ...]:
    """Make Playground's registry know all our tasks as `bayessim_mjx/<Task>`; the names."""
    made = tuple(f"{PREFIX}{task}" for task in names())
    for name, task in zip(made, names(), strict=True):
        dm_control_suite.register_environment(name, _maker(task), lambda task=task: default_config(task))
    registry.ALL_ENVS = (*registry.ALL_ENVS, *(name for name in made if name not in registry.ALL_ENVS))
    return made


def default_config(task: str) -> Any:
    """Playground's settings of a task, as a `ConfigDict`: times, s, `episode_length`, and `domain` (see `make`)."""
    env = environment(task)[0]
    return config_dict.create(
        task=task, ctrl_dt=env.dt, sim_dt=float(env.mj_model.opt.timestep), episode_length=int(env.episode_length),
        action_repeat=1, impl="jax", domain="nominal",
    )  # fmt: skip


def _maker(task: str) -> Any:
    def load(config: Any = None, config_overrides: Any = None) -> PlaygroundEnv:
        settings = default_config(task) if config is None else config.copy_and_resolve_references()
        settings.unlock()
        settings.update_from_flattened_dict(dict(config_overrides or {}))
        if settings.impl != "jax":
            raise UserError(f"impl = {settings.impl!r}: {PREFIX}{task} has jax here")
        more = {key: settings[key] for key in settings if key not in OWN}
        given = {"episodeLength": int(settings.episode_length)} | more
        return PlaygroundEnv(Under(*environment(task, settings.domain, given)), settings)

    return load


@flax.struct.dataclass
class Data:
    """What Playground keeps of a world and puts back when an episode begins again; `qpos` and the like for pictures."""

    world: Any
    clock: dict[str, jax.Array]
    mocap: tuple[jax.Array, jax.Array]

    @property
    def qpos(self) -> jax.Array:
        return self.world.qpos

    @property
    def qvel(self) -> jax.Array:
        return self.world.qvel

    @property
    def mocap_pos(self) -> jax.Array:
        return self.mocap[0]

    @property
    def mocap_quat(self) -> jax.Array:
        return self.mocap[1]

    @property
    def xfrc_applied(self) -> jax.Array:
        return jnp.zeros((*self.mocap[0].shape[:-2], 1, 6))


class PlaygroundEnv(MjxEnv):
    """`env` behind Playground's interface; the observation is {"state": policy's, "privileged_state": critic's}.

    Where a task has no group "critic", `privileged_state` is the policy's.
    """

    def __init__(self, env: Env, config: Any = None) -> None:
        default = {
            "ctrl_dt": env.dt, "sim_dt": float(env.mj_model.opt.timestep), "episode_length": int(env.episode_length),
            "action_repeat": 1, "impl": "jax",
        }  # fmt: skip
        super().__init__(config_dict.create(**default) if config is None else config)
        self.env = env

    def reset(self, rng: jax.Array) -> State:
        return self._state(self.env.reset(rng), {})

    def step(self, state: State, action: jax.Array) -> State:
        seen = {"policy": state.obs["state"], "critic": state.obs["privileged_state"]}
        before = OurState(state.data.world, seen, state.reward, state.done, state.metrics, state.data.clock)
        return self._state(self.env.step(before, jnp.clip(action, -1.0, 1.0)), state.info)

    def _state(self, ours: OurState, info: dict[str, Any]) -> State:
        seen = {"state": ours.obs["policy"], "privileged_state": ours.obs.get("critic", ours.obs["policy"])}
        clock = {key: value for key, value in ours.info.items() if key != "final_observation"}
        model = self.env.mj_model
        mocap = jnp.zeros((model.nmocap, 3)), jnp.zeros((model.nmocap, 4))
        data = Data(ours.pipeline_state, clock, mocap)
        return State(data, seen, ours.reward, ours.done, dict(ours.metrics), dict(info))  # type: ignore[arg-type]

    @property
    def xml_path(self) -> str:
        return ""

    @property
    def action_size(self) -> int:
        return self.env.action_size

    @property
    def mj_model(self) -> mujoco.MjModel:
        return self.env.mj_model

    @property
    def mjx_model(self) -> Any:
        return self.env.physics.model  # type: ignore[attr-defined]
