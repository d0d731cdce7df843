"""What videos show: the motion of a policy in one episode at given physics, with the time and the return so far."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from bayessim_mjx.config import Config
from bayessim_mjx.config.settings import MonitorConfig
from bayessim_mjx.monitor import video
from bayessim_mjx.quantities import fixed
from bayessim_mjx.rollout import rollout

FPS = 25
HOLD = 1.0  # seconds for which the last pose of an episode that ended early is shown


@dataclass(frozen=True)
class Motion:
    """One episode, until its end or the last step."""

    qpos: np.ndarray  # [T+1, nq]
    total: np.ndarray  # [T+1] return so far
    dt: float  # s between rows
    end: str = ""  # why it ended early
    mocap: np.ndarray | None = None  # [T+1, nmocap, 7] what the task marks in pictures, see `Task.marks`

    def captions(self) -> list[str]:
        """Write the caption over each row of qpos, `T+1` lines."""
        places = 0 if np.abs(self.total).max() >= 100 else 1 if np.abs(self.total).max() >= 10 else 2
        lines = [f"{self.dt * k:.2f} s    return {fixed(float(r), places)}" for k, r in enumerate(self.total)]
        return lines[:-1] + [f"{lines[-1]}    {self.end}".rstrip()]


def motion(env: Any, policy: Any, key: Any, theta: Any, length: int) -> Motion:
    """Record the motion of a policy, without its exploration, until the episode ends.

    Args:
        env, policy: a task of ours and a policy for it.
        key: of the start and of what else is drawn.
        theta: [d] physics.
        length: control steps at most.
    """
    thetas = jnp.asarray(theta, jnp.float32)[None]
    t = jax.tree.map(lambda x: np.asarray(x[0]), rollout(env, policy.replace(deterministic=True), key, thetas, length))
    n = int(t.valid.sum())
    end = "terminated" if t.terminated.any() else "time limit" if t.truncated.any() else ""
    qpos, total = t.qpos[: n + 1], np.concatenate([[0.0], np.cumsum(t.reward[:n])])
    return Motion(qpos, total, float(env.dt), end, env.marks(qpos, t.observation[: n + 1]))


def film(env: Any, config: Config) -> Callable[[Any, int, Any], Motion] | None:
    """(policy, control steps, theta [d]) -> `Motion` of one episode; None where no video is to be made."""
    if not config.monitor.video or not hasattr(env, "physics"):
        return None
    return lambda policy, length, theta: motion(env, policy, jax.random.PRNGKey(config.seed), theta, length)


def frames(
    model: Any,
    shown: Motion,
    settings: MonitorConfig,
    title: str,
    about: Mapping[str, Any] | None = None,
    path: Path | None = None,
    half: bool = False,
) -> np.ndarray | None:
    """Pictures [T', H, W, 3] of a motion in real time; None where they cannot be made, see `video.record`.

    Args:
        title: below the picture, with the time and the return so far; `about` {name: value} is written over its corner.
        half: half as wide and high as set, for the many videos of a training.
    """
    hold = round(HOLD / shown.dt) if shown.end == "terminated" else 0
    rows = np.concatenate([np.arange(len(shown.qpos)), np.full(hold, len(shown.qpos) - 1)])
    captions = shown.captions()
    return video.record(
        model,
        shown.qpos[rows],
        path,
        fps=FPS,
        width=settings.video_width // (1 + half),
        height=settings.video_height // (1 + half),
        dt=shown.dt,
        overlay_text=about,
        title=title,
        captions=[captions[k] for k in rows],
        mocap=None if shown.mocap is None else shown.mocap[rows],
    )
