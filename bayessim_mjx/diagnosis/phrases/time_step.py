"""Sentences on the time step of the simulator as delivered, and on the one that the diagnosis simulates with."""

from __future__ import annotations

COSTS = (
    "the simulator's time step of {own} costs {size}{error:.2g} rad or m within a window at {joint}. Every policy that "
    "is trained with it has this gap. "
)
REDUCES = "{finer}, or the integrator RK4 where nothing is in contact, reduces it."
REPLACED = "The diagnosis simulates by {used}, which leaves {left:.2g} noise standard deviations."
FINER = " The diagnosis simulates at {used}."
COUNTS = " The rest, {rest:.2g} noise standard deviations, counts as noise."
NO_NOISE = " The logs show no noise, so everything smaller than this counts as noise."


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
