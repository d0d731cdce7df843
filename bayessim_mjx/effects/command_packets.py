"""Commands in messages that arrive after varying times, or are lost: shared buses, radio, an operating system's delays.

Each control step sends one message. A drive obeys the newest one that it has, so that a message overtaken by a later
one has no effect. The impulse is exact: a sub-step applies the time average of what the drive obeys in it.
"""

import dataclasses
from typing import Any, ClassVar

import jax
import jax.numpy as jnp

from bayessim_mjx.effects.effect import Effect
from bayessim_mjx.effects.support import packets
from bayessim_mjx.effects.support.packets import Packets
from bayessim_mjx.effects.support.site import Site


@dataclasses.dataclass(frozen=True)
class CommandPackets(Packets, Effect):
    """u(t) is the command of the newest message with t_sent + d <= t; d is drawn for each message.

    One message serves all actuators where these are tied ("all"); else each has its own. Of one bus with several drives
    that is "all".

    Parameters: `delay`, mean of d, s, neutral 0; `jitter`, its standard deviation, s, neutral 0; `loss`, share of the
    messages that never arrive, neutral 0. `law`: see `Packets`.

    Attributes:
        lost: hold: the drive goes on with the last command; zero: it takes the command 0 until the next arrives.
    """

    name: ClassVar[str] = "command_packets"
    kind: ClassVar[str] = "actuator"
    last: ClassVar[bool] = True
    noun: ClassVar[str] = "varying command delay and loss"
    lacks: ClassVar[str] = "a varying command delay and lost commands"
    separates: ClassVar[str] = "times at which each command was sent and received (`sent:command`, `received:command`)"

    def init(self, at: Site) -> Any:
        """Return the messages of the last control steps, newest last, and what the drives obey; see `on_command`."""
        count = packets.slots(self, at)
        receivers = 1 if at.tied else len(at)
        return {
            "key": jnp.zeros(2, jnp.uint32),
            "sent": jnp.zeros((count, at.substeps, len(at))),
            "arrival": jnp.full((count, receivers), jnp.inf),  # rows of commands from the start of the control step
            "obeyed": jnp.zeros(len(at)),
            "fresh": jnp.ones((), bool),
        }

    def on_command(self, at: Site, memory: Any, command: jax.Array, theta: jax.Array) -> tuple[Any, jax.Array]:
        own, rows, values = command[:, at.ids], command.shape[0], at.values(theta)
        key, draw = jax.random.split(memory["key"])
        delay, gone = packets.draw(draw, packets.receivers(at, values), self.law)
        count = memory["arrival"].shape[0]
        most = jnp.float32((count - 1) * rows)
        arrival = jnp.minimum(delay / jnp.float32(at.timestep), most)
        message = own
        if self.lost == "zero":
            message = jnp.where(gone, 0.0, own)
        else:
            arrival = jnp.where(gone, jnp.inf, arrival)
        sent = jnp.concatenate([memory["sent"][1:], message[None]])
        arrivals = jnp.concatenate([memory["arrival"][1:] - rows, arrival[None]])
        obeyed = jnp.where(memory["fresh"], own[0], memory["obeyed"])
        received, last = _obeyed(sent, arrivals, obeyed, rows)
        on = jnp.any(values != 0, axis=1)
        memory = {"key": key, "sent": sent, "arrival": arrivals, "obeyed": last, "fresh": jnp.zeros((), bool)}
        return memory, command.at[:, at.ids].set(jnp.where(on, received, own))


def _obeyed(sent: jax.Array, arrival: jax.Array, obeyed: jax.Array, rows: int) -> tuple[jax.Array, jax.Array]:
    """(means over the rows of a control step `[rows, n]` of what drives obey, what they obey at its end `[n]`).

    Args:
        sent: `[messages, rows, n]`, oldest first; arrival: `[messages, n or 1]`, in rows from the start of the step.
        obeyed: `[n]`, before the first of them arrives.
    """
    # a message is obeyed from its arrival until that of any later one
    later = jax.lax.cummin(arrival, axis=0, reverse=True)
    until = jnp.concatenate([later[1:], jnp.full_like(arrival[:1], jnp.inf)])
    start = jnp.arange(rows, dtype=jnp.float32)[:, None, None]
    share = jnp.minimum(until, start + 1.0) - jnp.maximum(arrival, start)  # [rows, messages, n or 1]
    share = jnp.clip(share, 0.0, 1.0)
    before = jnp.clip(later[0] - start[:, 0], 0.0, 1.0)
    # a row of a message lasts as long as it did when it was sent; its last one goes on
    row = jnp.clip(jnp.floor(start - arrival), 0, rows - 1)
    row = jnp.broadcast_to(jnp.where(jnp.isfinite(arrival), row, 0), (rows, *sent.shape[::2])).astype(jnp.int32)
    each = jnp.take_along_axis(sent[None], row[:, :, None], axis=2)[:, :, 0]
    means = jnp.sum(share * each, axis=1) + before * obeyed
    newest = (arrival <= rows) & (until > rows)
    last = jnp.where(jnp.any(newest, axis=0), jnp.sum(newest * sent[:, -1], axis=0), obeyed)
    return means, last
