"""`bayessim.refine`: the product of the network's posteriors proposes, replays of the real trajectories decide."""

from __future__ import annotations

import dataclasses
import time

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax import Array

from bayessim_mjx.keys import branch
from bayessim_mjx.logs import Channels
from bayessim_mjx.loop.likelihood import Likelihood
from bayessim_mjx.loop.recorded import Recorded
from bayessim_mjx.loop.refinement import Refinement, refine
from bayessim_mjx.loop.state import Answer, Evidence, Loop, LoopState, Round
from bayessim_mjx.physics.tangent import in_tangent, noisy
from bayessim_mjx.rollout import Trajectory
from bayessim_mjx.tracking import Record

DRAWS = 1024  # thetas of one call
SHARE = 1e-4  # of the prior, at most: no training ends where the domain would have no mass at all


def no_motion(loop: Loop, rows: int) -> dict[str, Array] | None:
    """Room for the measured motion of `rows` real trajectories; None where logs keep it."""
    if isinstance(loop.source, Recorded):
        return None
    model, length = loop.env.physics.mj_model, loop.settings.trainTrajLen  # type: ignore[attr-defined]
    sizes = {"qpos": (length + 1, model.nq), "qvel": (length + 1, model.nv), "command": (length, model.nu)}
    return {name: jnp.zeros((rows, *size)) for name, size in (sizes | {"valid": (length,)}).items()}


def refine_by_replays(round_: Round, answer: Answer) -> tuple[Answer, Evidence]:
    """Refine the posterior by replays of all real trajectories so far, where `bayessim.refine` asks for it."""
    if not round_.loop.refines:
        return answer, Evidence()
    clock, loop, b, warnings = time.perf_counter(), round_.loop, round_.loop.settings, []
    likelihood = _likelihood(loop, round_.state, round_.known)
    if likelihood.silent.any() and not round_.number:
        warnings.append(f"bayessim.refine: {_without_noise(likelihood.silent, likelihood.physics.mj_model)}")
    if not likelihood.seen.any():
        return answer, Evidence(warnings=warnings)
    seed = int(jax.random.randint(branch(loop.key(round_.number, "fit"), 3), (), 0, 2**31 - 1))
    found = refine(answer.posterior, likelihood, seed=seed, draws=DRAWS, components=b.components)
    seconds = {"refine": time.perf_counter() - clock}
    warnings += [text for text in [found.warning()] if text]
    if not found.used and b.refine == "likelihood":
        warnings.append(f"bayessim.refine: {found.sentence()}")
    evidence = Evidence({"refinement": found}, scores(found), warnings, seconds)
    if not found.used:
        return answer, evidence
    posterior = found.posterior.reduce(b.components).rechart(loop.chart)
    posterior = dataclasses.replace(posterior, prior_weight=jnp.float32(min(b.priorShare, SHARE)))
    return dataclasses.replace(answer, posterior=posterior, source="replays"), evidence


def _without_noise(silent: np.ndarray, model: mujoco.MjModel) -> str:
    names = [f"{stream}:{name}" for stream in ("qpos", "qvel") for name in Channels.of(model).qvel]
    left_out = ", ".join(name for name, there in zip(names, silent, strict=True) if there)
    return (
        f"{left_out}: too few different values to see how noisy they are, so they have no part in the likelihood; "
        "a `sigma` beside the logs (real.noise of a surrogate) gives them one"
    )


def scores(found: Refinement) -> dict[str, float]:
    """Numbers for curves."""
    told = {"effective": found.refined.effective, "widening": found.widening}
    told |= {"simulations": float(found.refined.simulations), "used": float(found.used)}
    return {f"refine/{name}": float(value) for name, value in told.items()}


def stored(loop: Loop, state: LoopState, real: Trajectory) -> LoopState:
    """The state with the measured motion of this round's trajectories: a surrogate's sensors are as noisy as its
    observations.
    """
    if state.motion is None:
        return state
    first, source = int(state.round) * loop.settings.realTrajs, loop.source
    k_qpos, k_qvel = jax.random.split(branch(loop.key(int(state.round), "real"), 7))
    rows = {name: jnp.asarray(getattr(real, name)) for name in state.motion}
    model, noise = loop.env.physics.mj_model, source.noise  # type: ignore[union-attr,attr-defined]
    rows["qpos"] = noisy(model, k_qpos, rows["qpos"], noise)  # type: ignore[arg-type]
    rows["qvel"] = rows["qvel"] + noise * jax.random.normal(k_qvel, rows["qvel"].shape)  # type: ignore[operator]
    kept = {
        name: jax.lax.dynamic_update_slice(old, rows[name], (first, *[0] * (old.ndim - 1)))
        for name, old in state.motion.items()
    }
    return dataclasses.replace(state, motion=kept)


def _likelihood(loop: Loop, state: LoopState, known: int) -> Likelihood:
    """Of the first `known` real trajectories; windows of one log are grouped."""
    physics, source = loop.env.physics, loop.source  # type: ignore[attr-defined]
    model, each = physics.mj_model, loop.settings.realTrajs
    if isinstance(source, Recorded):
        index = source.order[np.arange(known) % len(source.order)]
        record = source.records(index)
        speeds = np.where(source.fast, source.noise["qvel"], np.inf)
        sensor = np.concatenate([in_tangent(model, np.asarray(source.noise["qpos"])), speeds])
        valid = np.ones(record.command.shape[:2])
        return Likelihood(physics, record, valid, sensor, each, groups=source.data["run"][index])
    motion = state.motion
    assert motion is not None
    rows = {name: value[:known] for name, value in motion.items()}
    record = Record(rows["qpos"], rows["qvel"], rows["command"])
    sensor = np.full(2 * model.nv, source.noise, float)  # type: ignore[union-attr]
    return Likelihood(physics, record, np.asarray(rows["valid"]), sensor, each)


__all__ = ["no_motion", "refine_by_replays", "scores", "stored"]
