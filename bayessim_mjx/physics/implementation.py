"""Which implementation of MuJoCo computes the physics under `env.impl=auto`: the faster one, where it was measured."""

import importlib.util
import warnings
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import jax

from bayessim_mjx.effects.effect import Effect, overrides
from bayessim_mjx.errors import UserError
from bayessim_mjx.physics import measured
from bayessim_mjx.physics.warp import INSIDE

# (task, kind of device) -> fewest worlds at which Warp was measured to be faster (docs/devices.md has the figures).
# FrankaCabinet is simulated twice as fast, but its policies needed three times as many steps with Warp's contacts
FASTER_FROM: Mapping[tuple[str, str], int] = {("Humanoid", "NVIDIA H200"): 4096, ("ShadowHand", "NVIDIA H200"): 16384}


class Choice(NamedTuple):
    """`jax` or `warp`, and why."""

    impl: str
    why: str


def choose(task: str, worlds: int | None, effects: Sequence[Effect] = (), device: str | None = None) -> Choice:
    """`warp` where it was faster for this task, on this device, with as many worlds or fewer; `jax` otherwise.

    What was measured on this machine goes first, as `bayessim-mjx implementations` keeps it; FASTER_FROM is second.

    Args:
        task: its name.
        worlds: how many are simulated together; None: not known, which means few.
        effects: those of the physics; Warp computes a timestep as a whole, so none may act inside it.
        device: its kind, as JAX calls it; None: of the default device.
    """
    if not installed():
        return Choice("jax", "warp-lang is not installed")
    for effect in effects:
        if any(overrides(effect, hook) for hook in INSIDE):
            return Choice("jax", f"{effect.name} acts inside the timestep, which Warp computes as a whole")
    device, worlds = kind() if device is None else device, worlds or 0
    fewer = [m for m in measured.current(_kept(), task, device) if m.worlds <= worlds]
    if fewer:
        return Choice(fewer[-1].faster, f"{_rates(fewer[-1])} with {fewer[-1].worlds} worlds, measured here")
    least = FASTER_FROM.get((task, device))
    if least is not None:
        where = f"{least} worlds" + (f", here are {worlds}" if worlds < least else "")
        return Choice("warp" if worlds >= least else "jax", f"Warp was faster on {device} from {where}")
    so_many = f"{worlds} worlds or fewer" if worlds else "few worlds"
    return Choice("jax", f"{task} was not measured on {device} with {so_many}; bayessim-mjx implementations does it")


def steps(task: str, effects: Sequence[Effect] = (), device: str | None = None) -> list[tuple[int, Choice]]:
    """(fewest worlds, what `choose` then takes), from one world on, wherever it takes another implementation."""
    device = kind() if device is None else device
    numbers = {1, FASTER_FROM.get((task, device), 1), *(m.worlds for m in measured.current(_kept(), task, device))}
    all_ = [(worlds, choose(task, worlds, effects, device)) for worlds in sorted(numbers)]
    return [here for i, here in enumerate(all_) if i == 0 or here[1].impl != all_[i - 1][1].impl]


def installed() -> bool:
    """Whether warp-lang is there."""
    return importlib.util.find_spec("warp") is not None


def kind() -> str:
    """Return the kind of the default device, as JAX calls it."""
    chosen = getattr(jax.config, "jax_default_device", None)  # a device, the name of a platform, or None
    return chosen.device_kind if isinstance(chosen, jax.Device) else jax.devices(chosen)[0].device_kind


def _kept() -> tuple[measured.Measurement, ...]:
    """Return the measurements; a file that is damaged is no reason to stop a training."""
    try:
        return measured.read(measured.path())
    except UserError as error:
        warnings.warn(f"env.impl = 'auto' goes without measurements: {error}", stacklevel=3)
        return ()


def _rates(m: measured.Measurement) -> str:
    if m.jax is None or m.warp is None:
        return f"{'JAX' if m.jax is None else 'Warp'} did not run"
    return f"JAX {measured.rate(m.jax)}, Warp {measured.rate(m.warp)} steps/s"
