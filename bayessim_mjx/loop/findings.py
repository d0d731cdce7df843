"""Findings of a round's inference for a person: scores, predictions, complaints about the fit and checks."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from bayessim_mjx.distributions import Distribution
from bayessim_mjx.inference import checks
from bayessim_mjx.inference.range_ends import Pile
from bayessim_mjx.loop.state import Answer, Evidence, Round
from bayessim_mjx.quantities import percent

PREDICTIVE_DRAWS = 64
CLIPPED = 0.01  # share of clipped summary entries worth a warning


def describe(round_: Round, answer: Answer) -> Evidence:
    """Describe the posterior by scores and predictions, and complain about the fit behind it."""
    loop, learnt, posterior = round_.loop, round_.learnt, answer.posterior
    assert loop.source is not None
    keys = [loop.key(number, "real") for number in range(round_.number + 1)]
    truth = loop.source.truth_of(keys, loop.settings.realTrajs)
    fields = {
        "posterior": posterior,
        "real": jax.tree.map(np.asarray, round_.real),
        "truth": truth,
        "predictive": _predict(round_, posterior),
    }
    fresh = int(round_.state.fit.fits) == 1
    warnings = complaints(posterior.names, learnt.fit, learnt.known_before, answer.source == "replays", fresh)
    return Evidence(fields, score(posterior, truth), warnings)


def conclude(round_: Round, answer: Answer, moves: tuple[Pile, ...]) -> tuple[float, Evidence]:
    """Conclude the checks; return the share of the prior to mix into the randomisation because of misfit."""
    verdict, names = round_.learnt.verdict, answer.posterior.names
    if verdict is None:
        return 0.0, Evidence(warnings=[pile.sentence() for pile in moves])
    found = checks.conclude(*verdict, answer.posterior, round_.loop.settings.distrust, moves or None)
    found = dataclasses.replace(found, sets=answer.sets)
    known_already = names if round_.number else _unknown(names, round_.learnt.fit)
    replaced = answer.source in ("replays", "set network")
    return found.prior_share, Evidence({"checks": found}, warnings=found.warnings(known_already, replaced))


def complaints(
    names: tuple[str, ...], fit: dict[str, Any], known_before: np.ndarray, by_replays: bool, fresh: bool
) -> list[str]:
    """List complaints about this round's fit.

    Args:
        names: of the parameters.
        fit: numbers of the fit.
        known_before: which parameters were identified [d].
        by_replays: whether the posterior is not the network's alone.
        fresh: whether it was the network's first fit.
    """
    texts, unknown = [], _unknown(names, fit)
    if unknown and not np.array_equal(fit["identified"], known_before):
        what = ", ".join(unknown)
        from_network = f"the network does not tell {what} from these trajectories; the posterior is that of replays"
        texts.append(from_network if by_replays else f"not identified by these trajectories, kept at the prior: {what}")
    if fit["clipped"] > CLIPPED:
        texts.append(f"{percent(fit['clipped'])} of the summaries' entries lie beyond 10 sd and were clipped")
    if fit["n_invalid"] > 0:
        texts.append(f"{int(fit['n_invalid'])} simulated trajectories left out: their summaries are not finite")
    if fresh and fit["best"] < 0:
        n = f"{int(fit['steps'])} steps on {int(fit['n_train'])} trajectories"
        other = "another summary (bayessim.summarizerFxn) or longer trajectories (bayessim.trainTrajLen) may tell more"
        hint = "" if np.any(fit["identified"]) else f"; {other}"
        texts.append(f"the network is the linear posterior that training begins at: {n} found none better{hint}")
    if fit["skipped"] > 0:
        texts.append(f"{int(fit['skipped'])} steps of the fit skipped: gradient not finite")
    return texts


def _unknown(names: tuple[str, ...], fit: dict[str, Any]) -> tuple[str, ...]:
    """Parameters that the fit gives back their prior."""
    return tuple(name for name, known in zip(names, fit["identified"], strict=True) if not known)


def score(domain: Distribution, truth: np.ndarray | None) -> dict[str, float]:
    """Log density of the truth where it is known, and per-parameter contraction and sd against the prior."""
    found = domain.estimates()
    scores = {f"contraction/{name}": float(c) for name, c in zip(domain.space.names, found.contraction, strict=True)}
    scores |= {f"width/{name}": float(w) for name, w in zip(domain.space.names, found.width, strict=True)}
    scores["prior_share"] = found.prior_share
    if truth is not None:
        if np.isfinite(gain := float(domain.log_gain(jnp.asarray(truth)))):  # a truth beyond the range has no density
            scores["log_p_truth"] = float(domain.log_prob(jnp.asarray(truth)))
            scores["gain_over_prior"] = gain
        scores["credible_level"] = float(domain.credible_level(jnp.asarray(truth)))
    return scores


def _predict(round_: Round, posterior: Distribution) -> dict[str, np.ndarray] | None:
    """Posterior predictive: the first real trajectory's commands replayed from its first state at posterior draws."""
    loop = round_.loop
    if getattr(loop.env, "physics", None) is None:
        return None
    assert loop.source is not None
    thetas = posterior.sample(loop.key(round_.number, "predict"), PREDICTIVE_DRAWS)
    motion = loop.source.repeated(round_.number * loop.settings.realTrajs, round_.real, thetas)
    return {name: np.asarray(value) for name, value in motion.items()}
