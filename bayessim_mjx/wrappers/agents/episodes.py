"""Returns and lengths of the episodes that ended last, whatever library trains."""

from collections import deque

import numpy as np

from bayessim_mjx.wrappers.worlds import Batch, Worlds

KEPT = 100  # episodes


class Recent:
    """Watches `worlds`; returns are as the task gives them, whatever the learner's scale."""

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
