"""Where trajectories begin: each is measured once, with noise, and all of them tell where they begin at all.

A start taken as measured is too far out on the mean, by the share of the noise in the spread of the starts. Motion then
seems to fade faster than it does, in every trajectory alike, and what that makes of damping and masses grows beside the
posterior's width with the root of their number (errors in variables; Neyman and Scott 1948). So starts are drawn to
their mean by that share, which is estimated: parametric empirical Bayes, Morris (1983), JASA 78, 47, eqs. 1.16 to 1.18.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from bayessim_mjx.physics.tangent import difference, integrate
from bayessim_mjx.tracking import Record

# degrees of freedom, no choice: 1 / chi^2 of the N - 1 that an estimated mean leaves has the mean 1 / (N - 3) (Stein)
LOST = 3


class Starts:
    """Measured starts of records, each channel by itself.

    Attributes:
        count: N.
        away: `[N, 2 nv]` position tangents and velocities, from their means.
    """

    def __init__(self, record: Record, model: mujoco.MjModel) -> None:
        self.record, self.model = record, model
        qpos, qvel = record.qpos[:, 0], record.qvel[:, 0]
        away = jax.vmap(lambda q: difference(model, q, qpos[0]))(qpos)
        channels = np.concatenate([np.asarray(away, float), np.asarray(qvel, float)], axis=1)
        self.count, self.away = len(channels), channels - channels.mean(0)

    def share(self, sensor: np.ndarray) -> np.ndarray:
        """[2 nv] of the measured spread that is noise of these standard deviations; 0 where nothing is measured."""
        seen, freedom = np.isfinite(sensor), self.count - LOST
        noise = freedom * np.where(seen, sensor, 0.0) ** 2
        if freedom <= 0:
            return np.zeros(len(sensor))
        return np.minimum(noise / np.maximum((self.away**2).sum(0), 1e-300), 1.0)

    def sd(self, sensor: np.ndarray) -> np.ndarray:
        """[2 nv] standard deviations of what is left unknown of a start, over all of them."""
        return sensor * np.sqrt(1 - self.share(sensor) * (1 - LOST / self.count) if self.count > LOST else 1.0)

    def begun(self, sensor: np.ndarray) -> Record:
        """The records, from their most likely starts under that noise of the sensors [2 nv]."""
        nv, r = self.model.nv, self.record
        step = jnp.asarray(-self.share(sensor) * self.away, jnp.float32)
        qpos = jax.vmap(lambda q, by: integrate(self.model, q, by))(r.qpos[:, 0], step[:, :nv])
        return r.replace(
            qpos=jnp.asarray(r.qpos).at[:, 0].set(qpos), qvel=jnp.asarray(r.qvel).at[:, 0].add(step[:, nv:])
        )


__all__ = ["Starts"]
