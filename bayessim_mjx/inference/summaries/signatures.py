"""Summaries by iterated integrals of the path (time, state, action), and their logarithm; algebra in signature.py."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from itertools import product
from typing import NamedTuple

import jax.numpy as jnp
from jax import Array

from bayessim_mjx.errors import UserError
from bayessim_mjx.inference import signature as sig
from bayessim_mjx.inference.summaries.summary import MAX_FEATURES, Stream, Summary, affordable, held, register

MOST_BY_DEFAULT = 12100  # BayesSimIG's limit n^depth <= 110^2 of the depth that it takes
DEPTH = 3


class _Kind(NamedTuple):
    """A signature, or its logarithm."""

    name: str
    size: Callable[[int, int], int]  # (channels, depth) -> features
    read: Callable[[sig.Levels], Array]
    words: str  # what its features are called
    shorter: tuple[_Kind, ...] = ()  # kinds with fewer features

    def depth(self, channels: int, depth: int | None = None) -> int:
        """`depth`, or by default 3, or 2 where channels^3 > 110^2 (BayesSimIG's rule, which went on to a useless 1).

        Raises:
            UserError: where that depth gives more than MAX_FEATURES features, naming the depths that do not.
        """
        if depth is None:
            depth = DEPTH if channels**DEPTH <= MOST_BY_DEFAULT else 2
        if depth < 1:
            raise UserError(f"{self.name}: depth = {depth}: must be at least 1")
        if (features := self.size(channels, depth)) > MAX_FEATURES:
            most = max(d for d in range(depth) if self.size(channels, d) <= MAX_FEATURES)
            others = [f"{self.name}_{most}"] * (most > 1)
            others += [kind.name for kind in self.shorter if kind.size(channels, 2) <= MAX_FEATURES]
            affordable(
                f"{self.name} of depth {depth} over {channels} channels", features, ", ".join([*others, "corrdiff"])
            )
        return depth


LOGARITHM = _Kind(
    "summary_logsignature", sig.log_size, lambda levels: sig.flatten(sig.lyndon(sig.log(levels))), "log-signature"
)
WHOLE = _Kind("summary_signatory", sig.size, sig.flatten, "signature", (LOGARITHM,))


def summary_signatory(
    states: Array, actions: Array, valid: Array | None = None, depth: int | None = None, parallel: bool = False
) -> Array:
    """Signature of the path (time, state, action) -> [n + n^2 + ... + n^depth], n = 1 + S + A; level k times k!.

    The path starts at 0 (so the first state is seen), time runs from 0 to 1, and an action is held during its step, so
    that int a_j ds_i is corrdiff's <tau_i, a_j>. `depth`: see `_Kind.depth`. `parallel` multiplies the increments as
    a tree (short paths, GPU) rather than one after the other. Lyons & McLeod 2022, arXiv 2206.14674, for the theory.
    """
    return _features(WHOLE, states, actions, valid, depth, parallel)


def summary_logsignature(
    states: Array, actions: Array, valid: Array | None = None, depth: int | None = None, parallel: bool = False
) -> Array:
    """The logarithm of summary_signatory at Lyndon words: the same information in fewer numbers -> [sum of Witt's].

    Level k has (1/k) sum_{d | k} mu(k/d) n^d entries: n, n(n-1)/2, (n^3-n)/3, ...
    """
    return _features(LOGARITHM, states, actions, valid, depth, parallel)


def _features(
    kind: _Kind, states: Array, actions: Array, valid: Array | None, depth: int | None, parallel: bool
) -> Array:
    states, actions = held(states, actions, valid)
    depth = kind.depth(1 + states.shape[1] + actions.shape[1], depth)
    return kind.read((sig.signature_tree if parallel else sig.signature)(path_increments(states, actions), depth))


def path_increments(states: Array, actions: Array) -> Array:
    """Steps [2 T + 1, 1 + S + A] of the path (time, state, action) from 0: actions jump, then time and state move."""
    (steps, a), s = actions.shape, states.shape[1]
    jumps = jnp.diff(actions, axis=0, prepend=jnp.zeros((1, a)))
    jumps = jnp.concatenate([jnp.zeros((steps, 1 + s)), jumps], axis=1)
    moves = [jnp.full((steps, 1), 1.0 / steps), jnp.diff(states, axis=0), jnp.zeros((steps, a))]
    both = jnp.stack([jumps, jnp.concatenate(moves, axis=1)], axis=1).reshape(2 * steps, 1 + s + a)
    return jnp.concatenate([base_increment(states[0], a)[None], both])


def base_increment(state: Array, action_size: int) -> Array:
    """From the origin to the first state [S]: without it a signature would not know where the path is."""
    return jnp.concatenate([jnp.zeros(1), state, jnp.zeros(action_size)])


def _names(
    kind: _Kind, steps: int, states: Sequence[str], actions: Sequence[str], depth: int | None = None
) -> list[str]:
    """Iterated integrals by the channels they run over; those of a logarithm as nested areas, by their Lyndon words."""
    channels = ["time", *states, *actions]
    depth = kind.depth(len(channels), depth)
    levels = [list(product(channels, repeat=k)) for k in range(1, depth + 1)]
    if kind is LOGARITHM:
        where = sig.lyndon_words(len(channels), depth)
        levels = [[level[i] for i in index] for level, index in zip(levels, where, strict=True)]
    return [f"{kind.words}({', '.join(word)})" for level in levels for word in level]


def _stream(kind: _Kind, steps: int, state_size: int, action_size: int, depth: int | None = None) -> Stream:
    levels_of = partial(sig.exp, depth=kind.depth(1 + state_size + action_size, depth))

    def init(state: Array) -> tuple[Array, Array, sig.Levels]:
        return state, jnp.zeros(action_size), levels_of(base_increment(state, action_size))

    def step(
        carry: tuple[Array, Array, sig.Levels], action: Array, state: Array, valid: Array | float = 1.0
    ) -> tuple[Array, Array, sig.Levels]:
        before, previous, levels = carry
        state, action = jnp.where(valid > 0, state, before), jnp.where(valid > 0, action, previous)
        jump = jnp.concatenate([jnp.zeros(1 + state_size), action - previous])
        move = jnp.concatenate([jnp.full(1, 1.0 / steps), state - before, jnp.zeros(action_size)])
        return state, action, sig.times_line(sig.times_line(levels, jump), move)

    return Stream(init, step, lambda carry: kind.read(carry[2]))


SIGNATORY = register(
    Summary("summary_signatory", summary_signatory, "depth", partial(_names, WHOLE), partial(_stream, WHOLE))
)
LOGSIGNATURE = register(
    Summary(
        "summary_logsignature", summary_logsignature, "depth", partial(_names, LOGARITHM), partial(_stream, LOGARITHM)
    )
)
