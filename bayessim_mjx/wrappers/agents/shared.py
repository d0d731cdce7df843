"""What the agents share: their episodes, their networks as policies of ours, and the folder of a checkpoint.

A folder is whole at every moment, as a kill may come at any of them.
"""

import shutil
from collections import deque
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

from bayessim_mjx.config import PPOConfig
from bayessim_mjx.rl import Policy
from bayessim_mjx.rl.normalise import EPSILON, Moments
from bayessim_mjx.wrappers.worlds import Batch, Worlds

KEPT = 100  # episodes
NEW, OLD = ".new", ".old"  # versions of a folder, while one takes the other's place


class Recent:
    """Returns and lengths of the episodes that ended last in `worlds`; returns without the learner's scale."""

    def __init__(self, worlds: Worlds) -> None:
        self._ended: deque[tuple[float, float]] = deque(maxlen=KEPT)
        worlds.watch = self._count

    def _count(self, batch: Batch) -> None:
        done = np.asarray(batch.terminated | batch.truncated)
        if done.any():
            pairs = zip(np.asarray(batch.returns)[done], np.asarray(batch.lengths)[done], strict=True)
            self._ended.extend((float(r), float(n)) for r, n in pairs)

    def metrics(self) -> dict[str, float]:
        """Their means by our tags; nothing while none has ended."""
        if not self._ended:
            return {}
        returns, lengths = np.mean(self._ended, 0)
        return {"Train/mean_reward": float(returns), "Train/mean_episode_length": float(lengths)}


def policy_of(
    layers: Sequence[tuple[Any, Any]], log_std: Any, config: PPOConfig, mean: Any = None, scale: Any = None
) -> Policy:
    """Make a policy that acts as the other library's network does at its mean.

    Args:
        layers: weights `[in, out]` and biases `[out]`, from the first to the last.
        log_std: log standard deviation of actions, `[A]`.
        config: whose activation the network has.
        mean, scale: observations are taken as (x - mean) / scale, `[S]`; None: as they are.
    """
    host = lambda x: jnp.asarray(np.array(x, np.float32))  # noqa: E731  a copy: trainers go on writing into theirs
    size = np.shape(layers[0][0])[0]
    zero, one = np.zeros(size), np.ones(size)
    # ours divides by sqrt(var) + EPSILON
    var = one if scale is None else np.maximum(np.asarray(scale, np.float64).reshape(-1) - EPSILON, 0.0) ** 2
    centre = zero if mean is None else np.asarray(mean, np.float64).reshape(-1)
    moments = Moments(host(centre), host(var), jnp.float32(0.0 if mean is None else 1.0))
    actor = {"layers": [{"w": host(w), "b": host(b)} for w, b in layers], "log_std": host(log_std).reshape(-1)}
    return Policy(actor, moments, config.activation, normalize=mean is not None, action_clip=config.action_clip)


def write_folder(folder: Path, save: Callable[[Path], None]) -> None:
    """Write `save`'s files into an empty folder that then becomes `folder`, in place of what was there."""
    new, old = folder.with_suffix(NEW), folder.with_suffix(OLD)
    shutil.rmtree(new, ignore_errors=True)
    new.mkdir(parents=True)
    save(new)
    if folder.is_dir():
        shutil.rmtree(old, ignore_errors=True)
        folder.rename(old)
    new.rename(folder)


def kept_folder(folder: Path) -> Path:
    """Find the folder, or its last version where a kill came before the new one was in its place."""
    return folder if folder.is_dir() else folder.with_suffix(OLD)


def clear_folders(parent: Path, steps: set[str]) -> None:
    """Remove all folders in `parent` but those of these checkpoints."""
    for folder in parent.iterdir():
        if folder.name not in steps:
            shutil.rmtree(folder, ignore_errors=True)
