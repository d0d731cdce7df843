"""Sentences on the time step of the simulator as delivered, and on the one that the diagnosis simulates with."""

from __future__ import annotations

import numpy as np

from bayessim_mjx.diagnosis.fitting.delivered import INTEGRATORS
from bayessim_mjx.diagnosis.fitting.discretisation import ENOUGH, Discretisation
from bayessim_mjx.diagnosis.fitting.integrator_choice import Choice, Step

COSTS = (
    "the simulator's time step of {own} costs {size}{error:.2g} rad or m within a window at {joint}. Every policy that "
    "is trained with it has this gap. "
)
REDUCES = "{finer}, or the integrator RK4 where nothing is in contact, reduces it."
REPLACED = "The diagnosis simulates by {used}, which leaves {left:.2g} noise standard deviations."
FINER = " The diagnosis simulates at {used}."
COUNTS = " The rest, {rest:.2g} noise standard deviations, counts as noise."
NO_NOISE = " The logs show no noise, so everything smaller than this counts as noise."
UNSTABLE = "the simulator is unstable at its time step of {own:.3g} ms: {joint} is too stiff or too light for it"
NOWHERE = (
    "{text}, and for {finer:.3g} ms too; no gap can be trusted there (more armature or damping, or a softer loop, at "
    "this joint would)"
)
STABLE = "{text}; the diagnosis simulates at {finer:.3g} ms or less{how}"
BEYOND = (
    "the simulator cannot be made fine enough: sub-steps of {step:.2g} ms still change the motion by {left:.2g} rad or "
    "m at {joint}, where {limit:.2g} may stay; smaller gaps are not seen"
)


def sentences(choice: Choice) -> tuple[list[str], list[str]]:
    """Return what the user reads before anything is fitted, and the warnings: the cost of the model's own step.

    A model that is unstable at its own step has no such cost.
    """
    said = [*unstable(choice.stable), *choice.better, *beyond(choice.worth)]
    return said, costs(choice.worth) if choice.stable.factor == 1 else []


def unstable(step: Step) -> list[str]:
    """Return the sentence on a model that is unstable at its own step."""
    if not step.joint:
        return []
    finer = 1e3 * step.timestep / step.factor
    text = UNSTABLE.format(own=1e3 * step.timestep, joint=step.joint)
    if not step.reached:
        return [NOWHERE.format(text=text, finer=finer)]
    how = f" by the integrator {INTEGRATORS[step.integrator]}" if step.changed else ""
    return [STABLE.format(text=text, finer=finer, how=how)]


def costs(step: Discretisation) -> list[str]:
    """Return the warning on a time step whose error is above the noise."""
    nv = len(step.channels)
    noises = step.own[:nv] / step.sigma[:nv]
    if noises.max() < 1:
        return []
    at = int(np.argmax(noises))
    size = "" if step.simulated[at] else f"{noises[at]:.1f} noise standard deviations, "
    own = milliseconds(step.timestep, step.delivered.integrator if step.delivered else "")
    text = COSTS.format(own=own, size=size, error=step.own[at], joint=step.channels[at])
    return [text + _remedy(step, noises[at], bool(step.simulated[at]))]


def _remedy(step: Discretisation, noises: float, simulated: bool) -> str:
    known, used = np.isfinite(step.sigma), milliseconds(step.timestep / step.factor)
    if step.delivered is not None:
        left = np.max(step.left[known] / step.sigma[known])
        return REPLACED.format(used=f"{step.integrator} at {used}", left=left)
    finer = milliseconds(step.timestep / 2 ** int(np.ceil(np.log2(noises))))
    text = REDUCES.format(finer="A shorter step" if simulated else f"A step of {finer}")
    text += FINER.format(used=used) if step.factor > 1 else ""
    if simulated:
        return text + NO_NOISE
    left = np.sqrt(np.maximum((step.floor[known] / step.sigma[known]) ** 2 - 1, 0.0)).max()
    return text + COUNTS.format(rest=left) if left > ENOUGH else text


def beyond(step: Discretisation) -> list[str]:
    """Return the sentence on steps of which none that can be afforded is fine enough."""
    nv = len(step.channels)
    if step.limit is None or not (over := step.left[:nv] / step.limit).max() > 1:
        return []
    at, finest = int(np.argmax(over)), 1e3 * step.timestep / step.factor
    return [BEYOND.format(step=finest, left=step.left[at], joint=step.channels[at], limit=step.limit[at])]


def milliseconds(seconds: float, integrator: str = "") -> str:
    """`5 ms`, `5 ms (implicitfast)`."""
    return f"{1e3 * seconds:.3g} ms{f' ({integrator})' if integrator else ''}"


def written(integrator: str, timestep: float, own: str, own_step: float) -> str:
    """Return the sentence on a corrected model or file: how the diagnosis simulated, in place of the delivered way."""
    used, before = (milliseconds(step) for step in (timestep, own_step))
    return (
        f"The diagnosis simulated by {integrator} at {used}, in place of {own} at {before}. The errors that it states "
        "hold for this integrator and this time step."
    )
