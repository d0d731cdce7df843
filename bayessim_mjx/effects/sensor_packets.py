"""Measurements in messages that arrive after varying times, or are lost: shared buses, radio, bursts of a driver."""

import dataclasses
from typing import Any, ClassVar

import jax
import jax.numpy as jnp

from bayessim_mjx.effects.effect import Effect, Measurement
from bayessim_mjx.effects.support import packets
from bayessim_mjx.effects.support.motion import delayed
from bayessim_mjx.effects.support.packets import Packets
from bayessim_mjx.effects.support.site import Site, columns, written


@dataclasses.dataclass(frozen=True)
class SensorPackets(Packets, Effect):
    """measured(t) = q(t - a): the age a is the delay drawn at t, but nothing older is shown than what was shown before.

    Between control steps the velocity is a parabola, as by `sensor_delay`. One message serves all joints
    where these are tied ("all"); else each has its own.

    Parameters: `delay`, mean of the delay, s, neutral 0; `jitter`, its standard deviation, s, neutral 0; `loss`, share
    of the measurements that never arrive, neutral 0. `law`: see `Packets`.

    Attributes:
        lost: hold: the last measurement stays; zero: positions and velocities read 0.
    """

    name: ClassVar[str] = "sensor_packets"
    kind: ClassVar[str] = "joint"
    noun: ClassVar[str] = "varying measurement delay and loss"
    lacks: ClassVar[str] = "a varying measurement delay and lost measurements"
    separates: ClassVar[str] = "times at which each measurement was sent and received (`sent:measurement` ...)"

    def init(self, at: Site) -> Any:
        """Return the measurements `[lag, n, 2]` after past control steps, newest last, and the age of the shown one."""
        lag = max(2, packets.slots(self, at))
        return {
            "key": jnp.zeros(2, jnp.uint32),
            "history": jnp.zeros((lag, len(at), 2)),
            "age": jnp.full(1 if at.tied else len(at), jnp.float32(lag)),
            "fresh": jnp.ones((), bool),
        }

    def on_measurement(
        self, at: Site, memory: Any, measurement: Measurement, theta: jax.Array
    ) -> tuple[Any, Measurement]:
        now, values, lag = columns(at, **measurement), at.values(theta), memory["history"].shape[0]
        key, draw = jax.random.split(memory["key"])
        delay, gone = packets.draw(draw, packets.receivers(at, values), self.law)
        past = jnp.where(memory["fresh"], now, memory["history"])
        age = jnp.minimum(delay / jnp.float32(at.dt), memory["age"] + 1.0)
        age = jnp.clip(jnp.where(gone, memory["age"] + 1.0, age), 0.0, lag)
        shown, history = delayed(past, now, jnp.broadcast_to(age, (len(at),)), at)
        if self.lost == "zero":
            shown = jnp.where(gone[:, None], 0.0, shown)
        shown = jnp.where(jnp.any(values != 0, axis=1, keepdims=True), shown, now)
        memory = {"key": key, "history": history, "age": age, "fresh": jnp.zeros((), bool)}
        return memory, written(at, **measurement, values=shown)
