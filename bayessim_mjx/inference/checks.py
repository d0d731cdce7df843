"""Checks of every inference: calibration, likeness of reality and simulation, identified parameters."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from bayessim_mjx.distributions import Distribution
from bayessim_mjx.inference import calibration, misspecification
from bayessim_mjx.inference.calibration import Report
from bayessim_mjx.inference.fit import condition
from bayessim_mjx.inference.identify import restore_prior
from bayessim_mjx.inference.misspecification import Misfit
from bayessim_mjx.inference.numbers import FEW, NEGLIGIBLE
from bayessim_mjx.inference.product_calibration import Sets
from bayessim_mjx.inference.range_ends import Pile, piles
from bayessim_mjx.inference.temperature import widened
from bayessim_mjx.quantities import percent, percent_estimate


@dataclass(frozen=True)
class Checks:
    """Everything that was found, on the host."""

    calibration: Report
    misfit: Misfit
    piles: tuple[Pile, ...]  # ends of ranges at which the posterior piles up
    flat: tuple[str, ...]  # sentences on parameters that were not identified
    prior_share: float  # of the prior, mixed into the randomisation because of the misfit
    sets: Sets | None = None  # posteriors of several trajectories as they are used, judged on simulated sets

    def guarded(self, posterior: Distribution) -> Distribution:
        """Mix a further share of the prior into the posterior, because of the misfit."""
        w, share = posterior.prior_weight, self.prior_share
        return replace(posterior, prior_weight=jnp.asarray(w + share * (1 - w), jnp.float32)) if share else posterior

    @property
    def scalars(self) -> dict[str, float]:
        """{name: number} for curves."""
        report, names = self.calibration, self.calibration.names
        found = {f"coverage_{100 * level:.0f}": share for level, (share, _) in report.coverage.items()}
        found |= {f"calibration_p/{name}": p for name, p in report.p.items()}
        found |= {f"expected_contraction/{n}": float(c) for n, c in zip(names, report.contraction, strict=True)}
        found |= {"temperature": report.temperature or 1.0, "misfit_p": self.misfit.joint}
        return found | {"misfit_prior_share": self.prior_share}

    def sentence(self) -> str:
        """One line: the verdict on the network, and on reality."""
        report = self.calibration
        reality = "unlike simulated ones" if self.misfit.flagged else "like simulated ones"
        return (
            f"network's posterior {report.words} ({report.evidence()}); "
            f"real trajectories {reality}, p = {self.misfit.joint:.2g}"
        )

    def warnings(self, known: Sequence[str] = (), refined: bool = False) -> list[str]:
        """Warnings that a person should act on; an earlier one said that the `known` parameters are not identified.

        Where the posterior is `refined`, that of the network was only a beginning and its faults are not the answer's.
        """
        texts = [text for text in self.flat if text.split(":")[0] not in known]
        if self.calibration.verdict != calibration.CALIBRATED and not refined:
            texts.append(f"posterior {self.calibration.words}: simulate more (bayessim.trainTrajs)")
        if self.misfit.flagged:
            share = f"; {percent(self.prior_share)} of the randomisation is drawn from the prior"
            texts.append(self.misfit.sentence() + (share if self.prior_share else ""))
        if self.sets is not None and self.sets.off and not refined:
            regions = ", ".join(f"its {percent(a)} region holds {percent_estimate(c, e)}" for a, c, e in self.sets.off)
            n = self.sets.counts[-1].trajectories
            texts.append(f"the posterior of {n} trajectories is over-confident as used: {regions} of true parameters")
        return texts + [pile.sentence() for pile in self.piles]

    def to_dict(self) -> dict[str, Any]:
        """Plain numbers, for JSON."""
        misfit = {"p": self.misfit.joint, "trajectories": self.misfit.p.tolist(), "sentence": self.misfit.sentence()}
        walls = [pile.to_dict() for pile in self.piles]
        values = {
            "calibration": self.calibration.to_dict(), "misfit": misfit, "walls": walls, "flat": list(self.flat),
            "prior_share": self.prior_share,
        }  # fmt: skip
        return values if self.sets is None else {**values, "sets": self.sets.to_dict()}


def examine(
    key: Array,
    network: Any,
    simulated: tuple[Array, Array, int],
    held: tuple[Array, Array],
    real: Array,
    rows: slice,
    *,
    temperature: float | None = None,
    tilt: Distribution | None = None,
    names: Sequence[str] = (),
) -> tuple[Report, Misfit]:
    """Calibration of the network and misfit of the real summaries.

    simulated: (thetas [N, d], x [N, D], valid rows) that the network was fitted on. held: fresh pairs (thetas, x) from
    the prior, or from `tilt`. real [n, D]: summaries, of which `rows` are judged; the rest is padding that spares a
    compilation. temperature: that of the posteriors judged; None: fitted where they are over-confident. names [D] of
    the features.
    """
    posteriors = conditioned(network, held[1])
    if temperature is None:
        report = calibration.corrected(key, posteriors, held[0], tilt)
    else:
        report = calibration.check(key, widened(posteriors, temperature), held[0], tilt=tilt)
        report = replace(report, temperature=None if temperature == 1.0 else temperature)
    misfit = misspecification.detect(network, simulated, held[1], real, names)
    return report, misfit.part(rows)


@jax.jit
def conditioned(network: Any, x: Array) -> Distribution:
    """Posterior of each summary x [n, D] as it is used: parameters that are not identified have their prior."""
    return jax.vmap(restore_prior, in_axes=(0, None))(condition(network, x), network.identified)


def conclude(
    report: Report, misfit: Misfit, posterior: Distribution, distrust: float, at_ends: Sequence[Pile] | None = None
) -> Checks:
    """Conclude the checks for the posterior given all real trajectories; at_ends: its `piles`, as far as known."""
    flat = flat_sentences(posterior.names, report.contraction, posterior.estimates().contraction)
    found = tuple(piles(posterior) if at_ends is None else at_ends)
    return Checks(report, misfit, found, tuple(flat), misfit.prior_share(distrust))


def flat_sentences(names: Sequence[str], expected: np.ndarray, real: np.ndarray) -> list[str]:
    """Name the parameters whose posterior is hardly narrower than the prior.

    `expected` [d] is the contraction 1 - var_posterior / var_prior on average over held-out pairs, `real` [d] that of
    the real trajectories together.
    """
    flat = [name for name, a, b in zip(names, expected, real, strict=True) if max(a, b) < NEGLIGIBLE]
    kind = [name for name, a, b in zip(names, expected, real, strict=True) if b < NEGLIGIBLE <= a]
    texts = [f"{name}: not identified by these trajectories" for name in flat]
    return texts + [
        f"{name}: not identified by the real trajectories, although most simulated ones would identify it"
        for name in kind
    ]


def replicated(
    key: Array,
    network: Any,
    x: Array,
    simulate: Callable[[Array, Array], Array],
    pairs: int = 200,
    each: int = 10,
    temperature: float = 1.0,
    tilt: Distribution | None = None,
) -> float:
    """p-value of the posterior predictive check; simulate(key, thetas [n, d]) -> summaries [n, D] is called once.

    `tilt`: the x were simulated at thetas from it instead of the prior, so draws are those of q tilt / prior.
    """
    x, keys = x[:pairs], jax.random.split(key, 3)
    posteriors = widened(conditioned(network, x), temperature)
    many = each if tilt is None else FEW * each
    draws = jax.vmap(lambda k, q: q.sample(k, many))(jax.random.split(keys[0], x.shape[0]), posteriors)
    if tilt is not None:
        # the highest of log weight + Gumbel noise, `each` times: drawn by weight, without repeats
        noisy = tilt.log_gain(draws) + jax.random.gumbel(keys[2], draws.shape[:2])
        best = jax.lax.top_k(noisy, each)[1]
        draws = jnp.take_along_axis(draws, best[:, :, None], axis=1)
    again = simulate(keys[1], draws.reshape(-1, draws.shape[-1]))
    return calibration.predictive(np.asarray(x), np.asarray(again).reshape(x.shape[0], each, -1))[0]


__all__ = ["Checks", "conclude", "examine", "flat_sentences", "replicated"]
