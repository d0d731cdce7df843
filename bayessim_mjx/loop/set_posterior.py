"""`bayessim.sets`: the posterior of all real trajectories by a network that sees them together (set_network.py).

Where replays have no likelihood, the product of the trajectories' posteriors is all that there is. The network of sets
is trained on sets simulated around that product. Both are judged on further sets that neither has seen.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from bayessim_mjx import inference
from bayessim_mjx.distributions import Distribution
from bayessim_mjx.errors import UserError
from bayessim_mjx.inference import product_calibration, restore_prior, set_network
from bayessim_mjx.inference.numbers import DRAWS
from bayessim_mjx.inference.product_calibration import Count
from bayessim_mjx.inference.rounds import REGION
from bayessim_mjx.inference.temperature import tempered
from bayessim_mjx.keys import branch
from bayessim_mjx.loop.examination import SETS
from bayessim_mjx.loop.posterior import conditioned, kept
from bayessim_mjx.loop.state import Answer, Evidence, Loop, LoopState, Round
from bayessim_mjx.loop.trajectories import features
from bayessim_mjx.quantities import fixed
from bayessim_mjx.rl import Policy

FITTED = DRAWS  # sets that the network is fitted on


@dataclass(frozen=True)
class SetPosterior:
    """Results of the network of sets and of the product, on the same sets, which the network was not fitted on.

    Attributes:
        network: of sets, so widened; see `product_calibration.Count`.
        product: of single posteriors, as it would be used.
        used: whether the posterior is that of the network.
    """

    network: Count
    product: Count
    used: bool

    def sentence(self) -> str:
        """One line: which of both, and why."""
        ours, theirs = fixed(self.network.gain, 1), fixed(self.product.gain, 1)
        which = "by a network of the whole set" if self.used else "by the product of single trajectories' posteriors"
        return f"{which}: on simulated sets {ours} nats over the prior by the network, {theirs} by the product"

    def to_dict(self) -> dict[str, Any]:
        """Plain numbers, for JSON."""
        return {"used": self.used, "sentence": self.sentence(), **self.scores}

    @property
    def scores(self) -> dict[str, float]:
        """Numbers for curves."""
        numbers = {"used": float(self.used), "gain": self.network.gain, "product": self.product.gain}
        numbers |= {"widening": self.network.widening}
        return numbers | {
            f"coverage_{100 * level:.0f}": self.network.coverage(level) for level in product_calibration.LEVELS
        }


def use_set_network(round_: Round, answer: Answer) -> tuple[Answer, Evidence]:
    """Replace the product by the posterior of a network of sets, where `bayessim.sets` asks for it."""
    b = round_.loop.settings
    if answer.source != "product" or b.sets == "product" or round_.known < 2:
        return answer, Evidence()
    clock = time.perf_counter()
    round_.begin("learning a network of sets")
    try:
        found, posterior = _learnt(round_.loop, round_.state, round_.policy, answer)
    except UserError as error:
        kept = f"bayessim.sets={b.sets}: the product of the posteriors is kept: {error}"
        return answer, Evidence(warnings=[kept], seconds={"sets": time.perf_counter() - clock})
    scores = {f"set_network/{name}": value for name, value in found.scores.items()}
    evidence = Evidence({"set_posterior": found}, scores, seconds={"sets": time.perf_counter() - clock})
    if not found.used:
        return answer, evidence
    return dataclasses.replace(answer, posterior=posterior, source="set network"), evidence


def _learnt(loop: Loop, state: LoopState, policy: Policy, answer: Answer) -> tuple[SetPosterior, Distribution]:
    """Learn from simulated sets; return the comparison and the network's posterior of the real trajectories."""
    b, source, product = loop.settings, loop.source, answer.posterior
    real = _usable(loop, state, product)
    k_learn, k_theta, *keys = jax.random.split(branch(loop.key(int(state.round), "fit"), 5), 2 + len(real))

    def simulate(key: Array, thetas: Array) -> Array:
        return features(source, key, thetas[None], policy)  # type: ignore[arg-type]

    network = set_network.learn(k_learn, state.fit, product, simulate, len(real), FITTED)

    def posteriors(columns: list[Array]) -> list[Distribution]:
        found = jax.vmap(restore_prior, in_axes=(0, None))(network.posteriors(columns), state.fit.identified)
        share = jnp.full_like(found.prior_weight, b.priorShare)
        return jax.tree.map(np.asarray, dataclasses.replace(found, prior_weight=share)).split()

    thetas = dataclasses.replace(product, prior_weight=jnp.float32(0)).sample(k_theta, SETS)
    columns = [simulate(k, thetas) for k in keys]

    def used(q: Distribution) -> Distribution:
        return q if answer.sets is None else answer.sets.used(q, len(real))

    each = zip(np.asarray(thetas), posteriors(columns), _products(loop, state, columns, used), strict=True)
    rows = [(at, whole, other) for at, whole, other in each if other is not None and whole.sound]
    (own,) = posteriors([x[None] for x in real])
    if len(rows) < SETS // 2 or not own.sound:
        raise UserError("too many simulated trajectories are not finite")
    at, wholes, products = zip(*rows, strict=True)
    ours = product_calibration.judge([[q] for q in wholes], np.stack(at), b.components).counts[0]
    theirs = product_calibration.judge(
        [[q] for q in products], np.stack(at), b.components, widened_by=lambda n: 1.0
    ).counts[0]
    posterior = tempered(inference.combine([own], b.components), ours.widening)
    return SetPosterior(ours, theirs, b.sets == "embedding" or ours.gain > theirs.gain), posterior


def _usable(loop: Loop, state: LoopState, product: Distribution) -> Array:
    """Select the real summaries [n, D] that a network of sets can be asked about."""
    b, round_ = loop.settings, int(state.round)
    if b.proposal == "division":
        raise UserError("bayessim.proposal=division has no posterior to simulate sets around")
    if round_ and loop.source.policy_dependent:  # type: ignore[union-attr]
        raise UserError(
            "earlier trajectories were made by other policies, which sets cannot be simulated with any more"
        )
    if float(product.prior_weight) >= REGION:
        raise UserError("they have no result yet")
    real = state.real_features[: (round_ + 1) * b.realTrajs]
    real = real[np.isfinite(np.asarray(real)).all(axis=1)]
    if not len(real):
        raise UserError("none of their summaries is finite")
    return real


def _products(
    loop: Loop, state: LoopState, columns: list[Array], used: Callable[[Distribution], Distribution]
) -> list[Distribution | None]:
    """Products of the sets, given as columns of summaries [m, D], as they are used; None where one is no density."""
    b, each = loop.settings, []
    for x in columns:
        factors = kept(conditioned(state.fit, x, state.temperature), state.fit.identified, b.priorShare)
        each.append(jax.tree.map(np.asarray, factors).split())
    rows = zip(*each, strict=True)
    return [
        used(inference.combine(row, b.components).rechart(loop.chart)) if all(q.sound for q in row) else None
        for row in rows
    ]


__all__ = ["SetPosterior", "use_set_network"]
