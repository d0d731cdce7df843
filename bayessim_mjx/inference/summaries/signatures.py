"""Summaries by iterated integrals of the path (time, state, action), and their logarithm: truncated path signatures.

An element 1 + a_1 + ... + a_N of the tensor algebra over n channels is the tuple (a_1 [..., n], ..., a_N [..., n^N]);
the entry of word (i_1, ..., i_k) stands at sum_j i_j n^(k-j). Chen: S(path, then path') = S(path) S(path').
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from functools import lru_cache, partial, reduce
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from bayessim_mjx.errors import UserError
from bayessim_mjx.inference.summaries.summary import MAX_FEATURES, Stream, Summary, affordable, held, register

DEPTH = 3  # of a signature by default; source: BayesSimIG
Levels = tuple[Array, ...]


def size(channels: int, depth: int) -> int:
    """Entries of a signature: n + n^2 + ... + n^depth."""
    return sum(channels**k for k in range(1, depth + 1))


def log_size(channels: int, depth: int) -> int:
    """Entries of a log-signature, Lyndon words of up to `depth` letters: sum_k 1/k sum_{d | k} mu(k/d) n^d (Witt)."""
    aperiodic: dict[int, int] = {}
    for k in range(1, depth + 1):
        aperiodic[k] = channels**k - sum(count for d, count in aperiodic.items() if k % d == 0)
    return sum(count // k for k, count in aperiodic.items())


def identity(channels: int, depth: int) -> Levels:
    """Return the signature of a path that stands still."""
    return tuple(jnp.zeros(channels**k) for k in range(1, depth + 1))


def exp(x: Array, depth: int) -> Levels:
    """Signature of the straight line with increment x [..., n]: x^k / k! at level k."""
    levels = [x]
    for k in range(2, depth + 1):
        levels.append(_outer(levels[-1], x / k))
    return tuple(levels)


def product(a: Levels, b: Levels) -> Levels:
    """Chen's product of two signatures: the first path, then the second."""
    return tuple(x + y + xy for x, y, xy in zip(a, b, _nilpotent(a, b), strict=True))


def times_line(a: Levels, x: Array) -> Levels:
    """product(a, exp(x)) by Horner's scheme, without forming exp(x): one step of a streaming signature, x [..., n]."""
    out = []
    for k in range(1, len(a) + 1):
        # a_k + (... ((x/k + a_1) x/(k-1) + a_2) ... + a_{k-1}) x/1
        term = x / k
        for i in range(1, k):
            term = _outer(term + a[i - 1], x / (k - i))
        out.append(a[k - 1] + term)
    return tuple(out)


def signature(increments: Array, depth: int) -> Levels:
    """Signature of the path with these increments [T, n], one after the other: memory of one signature."""
    start = identity(increments.shape[1], depth)
    return jax.lax.scan(lambda levels, x: (times_line(levels, x), None), start, increments)[0]


def signature_tree(increments: Array, depth: int) -> Levels:
    """Compute the same by a balanced tree of Chen products: depth log2 T, memory of T signatures."""
    steps = increments.shape[0]
    padding = (1 << max(steps - 1, 0).bit_length()) - steps  # standing still at the end changes nothing
    levels = exp(jnp.pad(increments, ((0, padding), (0, 0))), depth)
    while levels[0].shape[0] > 1:
        levels = product(tuple(a[0::2] for a in levels), tuple(a[1::2] for a in levels))
    return tuple(a[0] for a in levels)


def log(a: Levels) -> Levels:
    """Logarithm in the tensor algebra, a Lie element: s - s^2/2 + s^3/3 - ... for s = a - 1."""
    depth = len(a)
    out = tuple(x / depth for x in a)
    for m in range(depth - 1, 0, -1):
        out = tuple(x / m - y for x, y in zip(a, _nilpotent(a, out), strict=True))
    return out


def lyndon(levels: Levels) -> Levels:
    """Select the entries at Lyndon words, coordinates of a Lie element: none is lost, or depends on the others."""
    where = lyndon_words(levels[0].shape[-1], len(levels))
    return tuple(a[..., index] for a, index in zip(levels, where, strict=True))


@lru_cache
def lyndon_words(channels: int, depth: int) -> tuple[np.ndarray, ...]:
    """Positions of the Lyndon words in each level, in lexicographic order (Duval's algorithm)."""
    found: list[list[int]] = [[] for _ in range(depth)]
    word = [-1]
    while word:
        word[-1] += 1
        found[len(word) - 1].append(sum(letter * channels ** (len(word) - 1 - i) for i, letter in enumerate(word)))
        word = [word[i % len(word)] for i in range(depth)]
        while word and word[-1] == channels - 1:
            word.pop()
    return tuple(np.asarray(index, np.int32) for index in found)


def flatten(levels: Levels) -> Array:
    """All levels in one row, level k times k!: the words of a straight line are then products of its increments."""
    factorials = np.cumprod(np.arange(1, len(levels) + 1)).astype(np.float32)
    return jnp.concatenate([a * f for a, f in zip(levels, factorials, strict=True)], axis=-1)


def _outer(a: Array, b: Array) -> Array:
    return (a[..., :, None] * b[..., None, :]).reshape(*a.shape[:-1], a.shape[-1] * b.shape[-1])


def _nilpotent(a: Levels, b: Levels) -> Levels:
    """Compute (a - 1)(b - 1): level k is the sum of a_i b_{k-i}."""
    return (jnp.zeros_like(a[0]),) + tuple(
        reduce(jnp.add, [_outer(a[i - 1], b[k - i - 1]) for i in range(1, k)]) for k in range(2, len(a) + 1)
    )


class _Kind(NamedTuple):
    """A signature, or its logarithm."""

    name: str
    size: Callable[[int, int], int]  # (channels, depth) -> features
    read: Callable[[Levels], Array]
    words: str  # what its features are called
    shorter: tuple[_Kind, ...] = ()  # kinds with fewer features

    def depth(self, channels: int, depth: int | None = None) -> int:
        """Check a depth; by default 3, or 2 where that has more than MAX_FEATURES features.

        Raises:
            UserError: where that depth gives more than MAX_FEATURES features, naming the depths that do not.
        """
        if depth is None:
            depth = DEPTH if self.size(channels, DEPTH) <= MAX_FEATURES else DEPTH - 1
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


LOGARITHM = _Kind("summary_logsignature", log_size, lambda levels: flatten(lyndon(log(levels))), "log-signature")
WHOLE = _Kind("summary_signatory", size, flatten, "signature", (LOGARITHM,))


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
    """Take summary_signatory's logarithm at Lyndon words: the same information in fewer numbers -> [sum of Witt's].

    Level k has (1/k) sum_{d | k} mu(k/d) n^d entries: n, n(n-1)/2, (n^3-n)/3, ...
    """
    return _features(LOGARITHM, states, actions, valid, depth, parallel)


def _features(
    kind: _Kind, states: Array, actions: Array, valid: Array | None, depth: int | None, parallel: bool
) -> Array:
    states, actions = held(states, actions, valid)
    depth = kind.depth(1 + states.shape[1] + actions.shape[1], depth)
    return kind.read((signature_tree if parallel else signature)(path_increments(states, actions), depth))


def path_increments(states: Array, actions: Array) -> Array:
    """Make the steps [2 T + 1, 1 + S + A] of the path (time, state, action): actions jump, then time and state move."""
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
    """Name iterated integrals by the channels they run over; those of a logarithm, nested areas, by Lyndon words."""
    channels = ["time", *states, *actions]
    depth = kind.depth(len(channels), depth)
    levels = [list(itertools.product(channels, repeat=k)) for k in range(1, depth + 1)]
    if kind is LOGARITHM:
        where = lyndon_words(len(channels), depth)
        levels = [[level[i] for i in index] for level, index in zip(levels, where, strict=True)]
    return [f"{kind.words}({', '.join(word)})" for level in levels for word in level]


def _stream(kind: _Kind, steps: int, state_size: int, action_size: int, depth: int | None = None) -> Stream:
    levels_of = partial(exp, depth=kind.depth(1 + state_size + action_size, depth))

    def init(state: Array) -> tuple[Array, Array, Levels]:
        return state, jnp.zeros(action_size), levels_of(base_increment(state, action_size))

    def step(
        carry: tuple[Array, Array, Levels], action: Array, state: Array, valid: Array | float = 1.0
    ) -> tuple[Array, Array, Levels]:
        before, previous, levels = carry
        state, action = jnp.where(valid > 0, state, before), jnp.where(valid > 0, action, previous)
        jump = jnp.concatenate([jnp.zeros(1 + state_size), action - previous])
        move = jnp.concatenate([jnp.full(1, 1.0 / steps), state - before, jnp.zeros(action_size)])
        return state, action, times_line(times_line(levels, jump), move)

    return Stream(init, step, lambda carry: kind.read(carry[2]))


SIGNATORY = register(
    Summary("summary_signatory", summary_signatory, "depth", partial(_names, WHOLE), partial(_stream, WHOLE))
)
LOGSIGNATURE = register(
    Summary(
        "summary_logsignature", summary_logsignature, "depth", partial(_names, LOGARITHM), partial(_stream, LOGARITHM)
    )
)
