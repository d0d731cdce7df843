"""The lines with which a run begins: task, parameters, real side, budget, inference, device, seed."""

from __future__ import annotations

import math
from typing import Any

import yaml

from bayessim_mjx.config import Config
from bayessim_mjx.monitor.clock import reference
from bayessim_mjx.parameters.reading import GROUPS
from bayessim_mjx.quantities import MOST, compact, listed

# references (`clock.reference`) that the first start of `main --task Pendulum` spends on tracing and compiling; source:
# benchmarks/records/clock.json
COMPILES = 200
PLACES = {kind: group for group, (kind, _) in GROUPS.items() if kind in ("body", "geom", "joint", "tendon", "actuator")}
NO_NOISE = "the surrogate has no sensor noise: its posterior will be sharper than a robot's; set real.noise"
NAMES = {"jax": "MJX's JAX implementation", "warp": "MuJoCo Warp"}


def opening(config: Config, env: Any, device: Any, infers: bool = True) -> dict[str, Any]:
    """List {what: value} for `Console.start`; `infers`: the outer loop, else PPO alone."""
    lines: dict[str, Any] = {"task": f"{config.task}, {'adaptive domain randomisation' if infers else 'PPO alone'}"}
    if infers or config.randomization.get("randomize"):
        lines["parameters"] = [_range(p) for p in env.space.parameters] or _none(config)
    if config.domain is not None:
        lines["drawn from"] = config.domain
    if infers:
        logs = ", ".join([config.real.logs] if isinstance(config.real.logs, str) else map(str, config.real.logs or ()))
        drawn = "" if config.env.realParams is not None else ", drawn by the seed (env.realParams sets them)"
        surrogate = f"surrogate: the simulator at hidden parameters{drawn}"
        lines["real side"] = f"recorded motion in {logs}" if logs else surrogate
        if exact(config, env):
            lines["noise"] = NO_NOISE
    lines["budget"] = _budget(config, infers)
    if infers and config.bayessim.modelClass is not None:
        lines["inference"] = _inference(config.bayessim)
    lines["device"] = str(device)
    if (chosen := getattr(env, "chosen", None)) is not None:
        lines["physics"] = f"{NAMES[chosen.impl]}, taken by env.impl=auto: {chosen.why}"
    minutes = math.ceil(COMPILES * reference(steps=5000)[1] / 60)  # CPU time: more than one core need less
    most = f" (the pendulum's: up to {minutes} min on this machine)" if infers else ""
    note = f"the first start compiles its programs{most}, later starts load them from the cache"
    lines |= {"seed": config.seed, "note": note}
    return lines


def _none(config: Config) -> str:
    """Say that nothing is drawn, and how what a diagnosis recalibrated would be."""
    first = next((p for p in config.calibrated if p.get("kind") in PLACES), None)
    if first is None:
        return "none"
    span = {"range": [first["low"], first["high"]], "operation": first["operation"], "include": [first["target"]]}
    own = {"actor_params": {"robot": {PLACES[first["kind"]]: {first["attribute"]: span}}}}
    text = yaml.safe_dump({"task": {"randomization_params": own}}, default_flow_style=True, sort_keys=False, width=1e9)
    names = listed([str(p["name"]) for p in config.calibrated], most=MOST)
    return (
        f"none. The effects.yaml has no uncertain effects; its uncertainty is in the recalibrated parameters: {names}. "
        "They stay at their means, because this task does not randomise them. To draw one with the mean and error of "
        f"the file, give --cfg_env FILE with `{text.strip()}` (docs/effects.md)"
    )


def exact(config: Config, env: Any) -> bool:
    """Whether the posterior is that of a surrogate whose sensors add nothing."""
    infers = config.bayessim.modelClass is not None and len(env.space) > 0
    drawn = getattr(getattr(env, "nuisance", None), "observations", None)  # noise of the task's own section
    return infers and not config.real.logs and not config.real.noise and drawn is None


def _range(p: Any) -> str:
    unit = f" {p.unit}" if p.unit else ""
    return f"{p.name} {compact(p.low)} to {compact(p.high)}{unit}"


def _budget(config: Config, infers: bool) -> str:
    ppo, b = config.ppo, config.bayessim
    steps = ppo.max_iterations * ppo.num_steps * ppo.num_envs
    training = f"{ppo.max_iterations} PPO iterations × {ppo.num_envs} worlds × {ppo.num_steps} steps"
    if not infers:
        return f"{training} = {compact(steps)} steps"
    most = "at most " if b.untilSettled else ""
    whole = f"{most}{b.realIters} rounds × ({training}) = {compact(b.realIters * steps)} steps"
    if b.modelClass is None:
        return f"{whole}; no inference (bayessim.modelClass=None)"
    return f"{whole}; {b.trainTrajs} simulated trajectories per round to infer from"


def _inference(b: Any) -> str:
    """Network, summary and, where they are not the plain ones, coordinates, proposal and temperature."""
    parts = [b.modelClass if b.ensemble == 1 else f"{b.ensemble} × {b.modelClass}", b.summarizerFxn]
    parts += [f"{b.coordinates} coordinates"] if b.coordinates != "plain" else []
    parts += [f"later rounds simulated from the posterior ({b.proposal})"] if b.proposal != "prior" else []
    parts += [f"standard deviations times {b.temperature:g}"] if b.temperature not in (None, 1.0) else []
    return ", ".join(parts)
