"""Our environments as `gymnasium.Env` (one world) and `gymnasium.vector.VectorEnv` (many worlds in one batch).

`gymnasium.make("bayessim_mjx/Pendulum-v0")` and `gymnasium.make_vec("bayessim_mjx/Pendulum-v0", num_envs=64)` make them
too; keyword arguments beside those here are the task's `env:` settings (`episodeLength=100`).
"""

from collections.abc import Mapping
from typing import Any

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from bayessim_mjx import registry
from bayessim_mjx.compat import program
from bayessim_mjx.env import Env
from bayessim_mjx.errors import UserError
from bayessim_mjx.physics.warp import OVERFLOW, refuse_overflow
from bayessim_mjx.rl.worlds import clock, held, reset_at
from bayessim_mjx.rollout import next_episodes, select
from bayessim_mjx.wrappers.conversion import boxes
from bayessim_mjx.wrappers.pictures import Camera
from bayessim_mjx.wrappers.worlds import domain_of

RENDER_MODES = ("rgb_array",)
SAME, NEXT, DISABLED = AutoresetMode.SAME_STEP, AutoresetMode.NEXT_STEP, AutoresetMode.DISABLED


def make(
    task: str, theta: Any = None, render_mode: str | None = None, domain: Any = None, **env_settings: Any
) -> "GymnasiumEnv":
    """One world of the task; what `gymnasium.make` calls.

    Args:
        task: its name.
        theta, render_mode: see `GymnasiumEnv`.
        domain: as for `make_vec`.
        env_settings: settings of `env:`, e.g. `episodeLength=100`.
    """
    env = registry.make(task, numEnvs=1, **env_settings)
    return GymnasiumEnv(env, theta, render_mode, domain_of(env, domain))


def make_vec(
    task: str,
    num_envs: int = 1,
    domain: Any = None,
    autoreset_mode: AutoresetMode | str = NEXT,
    render_mode: str | None = None,
    **env_settings: Any,
) -> "GymnasiumVectorEnv":
    """Many worlds of the task; what `gymnasium.make_vec` calls.

    Args:
        task: its name.
        num_envs: worlds.
        domain: where theta comes from: a `Distribution`, "nominal", "prior", the folder of a run (its posterior), or a
            file that `Distribution.save` wrote.
        autoreset_mode, render_mode: see `GymnasiumVectorEnv`.
        env_settings: settings of `env:`, e.g. `episodeLength=100`.
    """
    env = registry.make(task, numEnvs=num_envs, **env_settings)
    return GymnasiumVectorEnv(env, num_envs, domain_of(env, domain), autoreset_mode, render_mode)


def _metadata(env: Env, render_mode: str | None) -> dict[str, Any]:
    """List what Gymnasium reads of an environment; UserError for a way of rendering that there is not."""
    modes = list(RENDER_MODES) if hasattr(env, "physics") else []
    if render_mode is not None and render_mode not in modes:
        raise UserError(f"render_mode = {render_mode!r}: allowed: None{''.join(f', {m!r}' for m in modes)}")
    dt = getattr(env, "dt", None)
    return {"render_modes": modes, "render_fps": 25 if dt is None else max(1, round(1.0 / dt))}


def _theta(env: Env, theta: Any, rows: tuple[int, ...] = ()) -> np.ndarray:
    """theta `[*rows, d]` from the same or from one `[d]`; UserError for another shape or beyond the parameters' box."""
    space, value = env.space, np.asarray(theta, np.float32)
    d = len(env.space.nominal)
    if value.shape not in ((d,), (*rows, d)):
        raise UserError(f"theta has shape {list(value.shape)}; expected {[d]}{f' or {[*rows, d]}' if rows else ''}")
    value = np.broadcast_to(value, (*rows, d))
    if hasattr(space, "contains") and not np.all(inside := np.asarray(space.contains(value))):
        row = value if not rows else value[int(np.argmin(inside))]
        i = int(np.argmin((row >= space.low) & (row <= space.high)))
        raise UserError(f"theta: {space.names[i]} = {row[i]:g}; allowed: [{space.low[i]:g}, {space.high[i]:g}]")
    return value


def _now(env: Env, state: Any) -> jax.Array:
    """Control steps since the first reset, which schedules go by."""
    return jnp.int32(0) if state is None else clock(env, state)


def _options(options: Mapping[str, Any] | None, allowed: tuple[str, ...]) -> dict[str, Any]:
    given = dict(options or {})
    for key in given:
        if key not in allowed:
            raise UserError(f"options[{key!r}]: unknown; allowed: {', '.join(allowed)}")
    return given


def _acted(action: Any, space: gymnasium.Space) -> jax.Array:
    """Return the action as an array.

    Raises:
        UserError: it has not the shape of the action space.
    """
    if np.shape(action) != space.shape:
        raise UserError(f"step: an action of shape {np.shape(action)}; allowed: {space.shape}, that of action_space")
    return jnp.asarray(action, jnp.float32)


class GymnasiumEnv(gymnasium.Env):
    """One world; observations are the group "policy". `reset(options={"theta": [d]})` sets theta from then on.

    With a `domain` every episode draws its own until then.

    Raises:
        UserError: theta of another shape or outside its box, an unknown option or render mode, a step before a reset.
    """

    def __init__(self, env: Env, theta: Any = None, render_mode: str | None = None, domain: Any = None) -> None:
        self.env, self.render_mode, self._domain = env, render_mode, domain if theta is None else None
        self.metadata = _metadata(env, render_mode)
        self.observation_space, self.action_space = boxes(env)
        self._theta = _theta(env, env.space.nominal if theta is None else theta)
        self._reset, self._step, self._camera = program(self._begun, env), program(env.step, env), Camera(env)
        self._state: Any = None

    def _begun(self, key: jax.Array, theta: jax.Array, now: Any) -> Any:
        """Begin a new episode; schedules go by the steps `now` of all episodes before it."""
        if getattr(self.env, "nuisance", None) is None:
            return self.env.reset(key, theta)
        return jax.tree.map(lambda x: x[0], reset_at(self.env, key, theta[None], None, now))

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple[np.ndarray, dict]:
        super().reset(seed=seed)
        given = _options(options, ("theta",))
        if "theta" in given:
            self._theta, self._domain = _theta(self.env, given["theta"]), None
        key = jax.random.PRNGKey(int(self.np_random.integers(2**31)))
        if self._domain is not None:
            key, theta_key = jax.random.split(key)
            self._theta = np.asarray(self._domain.sample(theta_key, 1)[0], np.float32)
        self._state = self._reset(key, self._theta, _now(self.env, self._state))
        return np.array(self._state.obs["policy"]), {"theta": np.array(self._theta)}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict]:
        if self._state is None:
            raise UserError("step before reset: call reset() first")
        self._state = self._step(self._state, _acted(action, self.action_space))
        info = self._state.info
        metrics = {name: float(value) for name, value in self._state.metrics.items()}
        observation = np.array(self._state.obs["policy"])
        terminated, truncated = bool(info["terminated"]), bool(info["truncated"])
        return observation, float(self._state.reward), terminated, truncated, metrics

    def render(self) -> np.ndarray | None:  # type: ignore[override]
        """Draw the present state as `[HEIGHT, WIDTH, 3]` uint8 where `render_mode` is "rgb_array"."""
        if self.render_mode is None or self._state is None:
            return None
        return self._camera(
            np.asarray(self._state.pipeline_state.qpos), self._theta, np.asarray(self._state.obs["policy"])
        )


class GymnasiumVectorEnv(VectorEnv):
    """`num_envs` worlds in one batch; theta comes from `domain` anew in each episode (None: nominal).

    Args:
        autoreset_mode: when an ended world restarts. "NextStep" (Gymnasium's default): in the next step, whose action
            is not used and whose reward is 0. "SameStep": in the same step; the last observation of the episode is
            info["final_obs"][i] where info["_final_obs"][i]. "Disabled": not before a call of `reset`.

    `reset(options=...)` takes `reset_mask` (bool `[num_envs]`: only these worlds) and `theta` (`[d]` or
    `[num_envs, d]`: parameters of the worlds that are reset, from then on).

    Raises:
        UserError: as `GymnasiumEnv`; also a `reset_mask` of another kind, and a step with ended worlds if "Disabled".
    """

    def __init__(
        self,
        env: Env,
        num_envs: int,
        domain: Any = None,
        autoreset_mode: AutoresetMode | str = NEXT,
        render_mode: str | None = None,
    ) -> None:
        if not isinstance(num_envs, int | np.integer) or num_envs < 1:
            raise UserError(f"num_envs = {num_envs!r}: must be a whole number of at least 1")
        try:
            self.mode = AutoresetMode(autoreset_mode)
        except ValueError:
            allowed = ", ".join(mode.value for mode in AutoresetMode)
            raise UserError(f"autoreset_mode = {autoreset_mode!r}; allowed: {allowed}") from None
        self.env, self.num_envs, self._domain, self.render_mode = env, int(num_envs), domain, render_mode
        self.metadata = _metadata(env, render_mode) | {"autoreset_mode": self.mode}
        self.single_observation_space, self.single_action_space = boxes(env)
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        self._reset, self._step = program(self._restarted, env), program(self._advanced, env)
        self._camera = Camera(env)
        self._key: Any = None
        self._state: Any = None
        self._ended = np.zeros(self.num_envs, bool)
        # parameters that `options` gave, and in which worlds they hold
        self._given = np.zeros((self.num_envs, len(env.space.nominal)), np.float32), np.zeros(self.num_envs, bool)
        self._thetas = self._given[0]

    def _fresh(self, key: jax.Array, domain: Any, given: tuple, now: Any) -> tuple[Any, jax.Array]:
        theta_key, reset_key = jax.random.split(key)
        nominal = jnp.asarray(self.env.space.nominal, jnp.float32)
        thetas = jnp.tile(nominal, (self.num_envs, 1)) if domain is None else domain.sample(theta_key, self.num_envs)
        thetas = jnp.where(given[1][:, None], given[0], thetas)
        state = reset_at(self.env, reset_key, thetas, None, now)
        return state, held(self.env, state, thetas)

    def _restarted(
        self, key: jax.Array, old: tuple | None, mask: jax.Array, domain: Any, given: tuple, now: Any
    ) -> tuple[Any, jax.Array]:
        """(state, thetas) with the worlds in `mask` begun anew, `now` control steps after the first reset."""
        fresh = self._fresh(key, domain, given, now)
        return fresh if old is None else select(mask, fresh, old)

    def _advanced(
        self, key: jax.Array, old: tuple, ended: jax.Array, action: jax.Array, domain: Any, given: tuple
    ) -> tuple[Any, tuple[Any, jax.Array]]:
        """Advance by one step: (what it led to, (state, thetas) to go on from)."""
        state, thetas = old
        after = jax.vmap(self.env.step)(state, action)
        if self.mode is DISABLED:
            return after, (after, thetas)
        again = ended if self.mode is NEXT else after.info["terminated"] + after.info["truncated"] > 0
        fresh, drawn = self._fresh(key, domain, given, clock(self.env, state))
        fresh = next_episodes(self.env, again, after, fresh)
        begun = select(again, (fresh, held(self.env, fresh, drawn)), (after, thetas))
        return (begun[0] if self.mode is NEXT else after), begun

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple[np.ndarray, dict]:
        super().reset(seed=seed)
        option = _options(options, ("theta", "reset_mask"))
        mask = self._mask(option["reset_mask"]) if "reset_mask" in option else np.ones(self.num_envs, bool)
        if "theta" in option:
            value = _theta(self.env, option["theta"], (self.num_envs,))
            old, held = self._given
            self._given = np.where(mask[:, None], value, old), held | mask
        if seed is not None or self._key is None:
            self._key = jax.random.PRNGKey(int(self.np_random.integers(2**31)))
        self._key, key = jax.random.split(self._key)
        before = None if mask.all() else (self._state, self._thetas)
        now = _now(self.env, self._state)
        self._state, self._thetas = self._reset(key, before, mask, self._domain, self._given, now)
        self._ended = self._ended & ~mask
        return np.array(self._state.obs["policy"]), {"theta": np.array(self._thetas), "_theta": mask}

    def _mask(self, mask: Any) -> np.ndarray:
        if not isinstance(mask, np.ndarray) or mask.dtype != np.bool_ or mask.shape != (self.num_envs,):
            got = f"{mask.dtype} {list(mask.shape)}" if isinstance(mask, np.ndarray) else repr(mask)
            raise UserError(f"options['reset_mask'] is {got}; expected a numpy array, bool {[self.num_envs]}")
        if not mask.any():
            raise UserError("options['reset_mask'] names no world")
        if self._state is None and not mask.all():
            raise UserError("options['reset_mask'] before the first reset: all worlds have to begin")
        return mask

    def step(self, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict]:
        if self._state is None:
            raise UserError("step before reset: call reset() first")
        if self.mode is DISABLED and self._ended.any():
            raise UserError(f"worlds {np.flatnonzero(self._ended).tolist()} have ended: reset them with a reset_mask")
        self._key, key = jax.random.split(self._key)
        old, acted = (self._state, self._thetas), _acted(actions, self.action_space)
        after, (self._state, self._thetas) = self._step(key, old, self._ended, acted, self._domain, self._given)
        terminated, truncated = (np.asarray(after.info[name]) > 0 for name in ("terminated", "truncated"))
        refuse_overflow(np.mean(after.metrics.get(OVERFLOW, 0.0)), "the worlds in this step")
        reward = np.array(after.reward)
        if self.mode is NEXT:
            reward[self._ended] = 0.0
        self._ended = ended = terminated | truncated
        info = self._final(after, ended) if self.mode is SAME and ended.any() else {}
        return np.array(self._state.obs["policy"]), reward, terminated, truncated, info

    def _final(self, after: Any, ended: np.ndarray) -> dict[str, Any]:
        """List the last observations of the episodes that ended."""
        final, last = np.empty(self.num_envs, object), np.array(after.info["final_observation"]["policy"])
        for i in np.flatnonzero(ended):
            final[i] = last[i]
        return {"final_obs": final, "_final_obs": ended, "final_info": {}, "_final_info": ended}

    def render(self) -> tuple[np.ndarray, ...] | None:  # type: ignore[override]
        """Draw a picture of each world, as `GymnasiumEnv.render`."""
        if self.render_mode is None or self._state is None:
            return None
        shown = self._state.pipeline_state.qpos, self._thetas, self._state.obs["policy"]
        frames = [self._camera(*world) for world in zip(*map(np.asarray, shown), strict=True)]
        return None if any(frame is None for frame in frames) else tuple(frames)  # type: ignore[arg-type]
