"""Truncated path signatures: iterated integrals of a piecewise linear path, and their logarithm.

An element 1 + a_1 + ... + a_N of the tensor algebra over n channels is the tuple (a_1 [..., n], ..., a_N [..., n^N]);
the entry of word (i_1, ..., i_k) stands at sum_j i_j n^(k-j). Chen: S(path, then path') = S(path) S(path').
"""

from __future__ import annotations

from functools import lru_cache, reduce

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

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
    """The signature of a path that stands still."""
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
    """The same as a balanced tree of Chen products: depth log2 T, memory of T signatures."""
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
    """The entries at Lyndon words, coordinates of a Lie element: nothing is lost, and none depends on the others."""
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
    """(a - 1)(b - 1): level k is the sum of a_i b_{k-i}."""
    return (jnp.zeros_like(a[0]),) + tuple(
        reduce(jnp.add, [_outer(a[i - 1], b[k - i - 1]) for i in range(1, k)]) for k in range(2, len(a) + 1)
    )
