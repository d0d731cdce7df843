"""Features of the measured motion for a flexible force: laws of a joint's own motion, couplings, random functions."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from bayessim_mjx.diagnosis.residual.motion_inputs import QUANTITIES, Inputs

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Sizes:
    """How many features are drawn and kept, and how far they may extrapolate."""

    random: int = 24  # random features per joint and seed
    picked: int = 5  # inputs of each
    limit: float = 4.0  # standard deviations at which features are clipped: no extrapolation


SIZES = Sizes()


@dataclass(frozen=True, eq=False)
class Features:
    """Phi of each joint: `phi [W, m, nv, F]`, standardised, of inputs `z [W, H, I]` named (joint, quantity)."""

    phi: Array
    names: tuple[tuple[int, str], ...]


@dataclass(frozen=True, eq=False)
class Mapping:
    """Inputs -> features of one seed; standardised by the logs it was drawn on."""

    names: tuple[tuple[int, str], ...]
    weights: Array  # [nv, RANDOM, I]
    shifts: Array  # [nv, RANDOM]
    moments: list[tuple[Array, Array]] = field(default_factory=list)

    @classmethod
    def draw(cls, inputs: Inputs, seed: int) -> Mapping:
        nv = len(inputs.joints)
        names = tuple((v, quantity) for v in range(nv) for quantity in QUANTITIES)
        rng = np.random.default_rng(seed)
        weights = np.zeros((nv, SIZES.random, len(names)))
        for v in range(nv):
            own = np.array([1.0 if joint == v else 0.5 / max(nv - 1, 1) for joint, _ in names])
            own[[i for i, (_, q) in enumerate(names) if q == "time"]] *= 0.3
            for f in range(SIZES.random):
                picked = rng.choice(len(names), SIZES.picked, replace=False, p=own / own.sum())
                weights[v, f, picked] = rng.normal(size=SIZES.picked) * rng.choice([0.5, 1.0, 2.0])
        return cls(names, weights, rng.uniform(-1.5, 1.5, (nv, SIZES.random)))

    def __call__(self, inputs: Inputs, average: Array) -> Features:
        """Standardised features at the nodes; the first call fixes the standardisation."""
        z = self._inputs(inputs)
        random = np.tanh(np.einsum("whi,vfi->whvf", z, self.weights, optimize=True) + self.shifts)
        raw = np.concatenate([own_features(inputs), cross_features(inputs), random], 3)
        phi = np.einsum("hm,whvf->wmvf", average, raw, optimize=True)
        phi = self._standard(1, phi)
        return Features(np.concatenate([np.ones((*phi.shape[:3], 1)), phi], 3), self.names)

    def _inputs(self, inputs: Inputs) -> Array:
        z = [_single(inputs.of(q))[..., v] for v, q in self.names]
        return self._standard(0, np.stack(z, 2))

    def _standard(self, which: int, values: Array) -> Array:
        if len(self.moments) <= which:
            mean, sd = values.mean((0, 1)), values.std((0, 1))
            self.moments.append((mean, np.where(sd > 1e-9 * (np.abs(mean) + 1e-9), sd, np.inf)))
        mean, sd = self.moments[which]
        return np.clip((values - mean) / sd, -SIZES.limit, SIZES.limit)


def _single(values: Array) -> Array:
    """`[W, H, nv]`: of quantities that come in two sizes the second."""
    return values if values.ndim == 3 else values[..., 1]


def own_features(inputs: Inputs) -> Array:
    """`[W, H, nv, F]`: laws that forces in a joint may follow, of that joint's own motion."""
    q, w, s = inputs.position, inputs.speed / inputs.speed_scale, inputs.direction
    load, effort = inputs.load / inputs.load_scale, inputs.effort / inputs.effort_scale
    sign, fast = np.tanh(w / 0.02), np.tanh(w / 0.2)
    turn = np.where(inputs.hinge, 1.0, 0.0)
    recent = s * np.exp(-inputs.since_reversal / 0.1)
    columns = [
        q, np.sin(q) * turn, np.cos(q) * turn, w, sign, fast, w * np.abs(w),
        s, recent, inputs.stop[..., 0], inputs.stop[..., 1],
        effort, np.abs(effort), effort * np.abs(effort), np.abs(effort) * sign, load, np.abs(load) * sign,
        inputs.pull, inputs.past[..., 0], inputs.past[..., 1],
        inputs.time, inputs.time * sign, inputs.time * effort,
        q * sign, np.sin(q) * turn * sign, np.cos(q) * turn * sign,
    ]  # fmt: skip
    return np.stack(columns, 3)


def cross_features(inputs: Inputs) -> Array:
    """`[W, H, nv, F]`: what other joints do, for couplings; nothing for one joint alone."""
    nv = len(inputs.joints)
    w = inputs.speed / inputs.speed_scale
    rows = []
    for v in range(nv):
        others = [u for u in range(nv) if u != v]
        parts = [np.tanh(w[..., others] / 0.1), w[..., others], inputs.effort[..., others], inputs.pull[..., others]]
        rows.append(np.concatenate(parts, 2))
    return np.stack(rows, 2)
