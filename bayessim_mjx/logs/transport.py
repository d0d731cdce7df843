"""How long messages travel, and how many are lost, from the times at which they were sent and received."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping

import numpy as np
from scipy.special import gammaincinv

from bayessim_mjx.errors import UserError
from bayessim_mjx.logs.log import Array
from bayessim_mjx.logs.mapping import Source
from bayessim_mjx.logs.stamps import seconds_of
from bayessim_mjx.logs.table import Table

DIRECTIONS = {"command": "command_packets", "measurement": "sensor_packets"}  # of messages, and the effect of each
FEWEST = 30  # messages below which a standard deviation is off by more than an eighth: 1 / sqrt(2 n), a Gaussian's
WIDE = 2.0  # a bus under another load is within this factor; no source: a rule of thumb
ALIKE = 0.3  # correlation of neighbours from which on delays are not independent draws; no source: a matter of taste


@dataclasses.dataclass(frozen=True)
class Transport:
    """The delays of messages.

    Attributes:
        messages: how many were sent. mean, jitter (standard deviation), late (99 % are faster): s. loss: share.
        law: gamma, uniform or two_point, whose quantiles with this mean and jitter are the nearest ones.
        ahead: whether some arrive before they were sent: two clocks. mean and late then count from the fastest.
        correlation: of the delays of neighbours.
    """

    messages: int
    mean: float
    jitter: float
    late: float
    loss: float
    law: str
    ahead: bool
    correlation: float


def transport(sent: Array, received: Array) -> Transport | None:
    """Return the delays of messages [T] sent and received at these times, s; None: fewer than `FEWEST`.

    Rows that repeat a time of sending show the same message. It is lost where the time of receipt is NaN.
    """
    known = np.isfinite(sent)
    sent, first = np.unique(sent[known], return_index=True)
    delay = received[known][first] - sent
    arrived = delay[np.isfinite(delay)]
    if len(arrived) < FEWEST:
        return None
    ahead = bool(arrived.min() < 0)
    arrived = arrived - arrived.min() if ahead else arrived
    mean, jitter = float(arrived.mean()), float(arrived.std())
    away = arrived - mean
    correlation = float(away[1:] @ away[:-1] / (away @ away)) if jitter > 0 else 0.0
    late, loss = float(np.quantile(arrived, 0.99)), 1.0 - len(arrived) / len(delay)
    return Transport(len(sent), mean, jitter, late, loss, _law(arrived, mean, jitter), ahead, correlation)


def _law(delays: Array, mean: float, jitter: float) -> str:
    """Name the law whose quantiles are nearest to those of the delays, in the mean square (Wasserstein's distance)."""
    if not jitter > 0 or not mean > 0:
        return "gamma"
    x = np.sort(delays)
    share, shape = (np.arange(len(x)) + 0.5) / len(x), (mean / jitter) ** 2
    laws = {
        "gamma": gammaincinv(shape, share) * mean / shape,
        "uniform": mean + math.sqrt(3.0) * jitter * (2.0 * share - 1.0),
        "two_point": mean + jitter * np.sign(share - 0.5),
    }
    apart = {law: float(np.mean((quantiles - x) ** 2)) for law, quantiles in laws.items()}
    return min(apart, key=lambda law: apart[law])


def described(table: Table, sources: Mapping[str, Source]) -> list[str]:
    """Return a sentence for each direction whose stamps a file has (`sent:command`, `received:command` ...)."""
    plain = {f"{end}:{direction}" for end in ("sent", "received") for direction in DIRECTIONS} & set(table.columns)
    sources, said = {**{column: Source(column) for column in plain}, **sources}, []
    for direction, effect in DIRECTIONS.items():
        ends = [f"{end}:{direction}" for end in ("sent", "received")]
        have = [end for end in ends if end in sources]
        if len(have) == 1:
            lost = next(end for end in ends if end not in sources)
            said.append(f"{table.path.name}: {have[0]} gives no delay without {lost}")
        if len(have) < 2:
            continue
        try:
            found = transport(*(_times(table, sources[end], end) for end in ends))
        except UserError as error:
            said.append(str(error))
            continue
        if found is None:
            said.append(f"{table.path.name}: {direction}s: fewer than {FEWEST} messages arrive; no delays are read")
        else:
            said.append(f"{table.path.name}: {_sentence(direction, effect, found)}")
    return said


def _times(table: Table, source: Source, where: str) -> Array:
    """Return stamps in s: by the map's unit or scale, else as stamps of rows are read."""
    if source.stated:
        return source.read(table, where)
    name = source.name(table, where)
    return seconds_of(source.read(table, where), table, name)


def _sentence(direction: str, effect: str, found: Transport) -> str:
    ms = 1e3
    start = "the fastest" if found.ahead else "they are sent"
    text = (
        f"{direction}s arrive {ms * found.mean:.3g} ms after {start} (sd {ms * found.jitter:.3g} ms, 99 % within "
        f"{ms * found.late:.3g} ms), {100 * found.loss:.2g} % of {found.messages} are lost"
    )
    if found.ahead:
        text += "; some arrive before they are sent, so the stamps are of two clocks and the mean delay is unknown"
    if found.correlation > ALIKE:
        text += f"; neighbours are alike (correlation {found.correlation:.2f}), the effect draws each by itself"
    values = {"delay": found.mean, "jitter": found.jitter, "loss": found.loss}
    each = (f"{n}: {{nominal: {v:.3g}, range: [{v / WIDE:.3g}, {v * WIDE:.3g}]}}" for n, v in values.items() if v > 0)
    given = ", ".join(each)
    return f"{text}; for training: {{effect: {effect}, where: all, law: {found.law}, parameters: {{{given}}}}}"


__all__ = ["Transport", "described", "transport"]
