"""Which implementation of MuJoCo computes the physics under `env.impl=auto`: the faster one, where it was measured."""

import importlib.util
from collections.abc import Mapping, Sequence

import jax

from bayessim_mjx.effects.effect import Effect, overrides
from bayessim_mjx.physics.warp import INSIDE

# (task, kind of device) -> fewest worlds at which Warp was measured to be faster (docs/devices.md has the figures)
FASTER_FROM: Mapping[tuple[str, str], int] = {("Cartpole", "NVIDIA H200"): 16384, ("Ant", "NVIDIA H200"): 16384}


def choose(task: str, worlds: int | None, effects: Sequence[Effect] = (), device: str | None = None) -> str:
    """`warp` where it was faster for this task, on this device, with as many worlds or fewer; `jax` otherwise.

    Args:
        task: its name.
        worlds: how many are simulated together; None: not known, which means few.
        effects: those of the physics; Warp computes a timestep as a whole, so none may act inside it.
        device: its kind, as JAX calls it; None: of the first device.
    """
    if importlib.util.find_spec("warp") is None or any(overrides(e, hook) for e in effects for hook in INSIDE):
        return "jax"
    least = FASTER_FROM.get((task, jax.devices()[0].device_kind if device is None else device))
    return "warp" if least is not None and (worlds or 0) >= least else "jax"
