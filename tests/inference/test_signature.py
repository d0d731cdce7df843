"""Signatures against iterated integrals by hand, and the identities they must satisfy."""

import itertools
import math
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from bayessim_mjx.inference.summaries import signatures as sig

pytestmark = pytest.mark.usefixtures("strict")


def path(seed: int, steps: int, channels: int) -> jax.Array:
    return jnp.asarray(np.random.default_rng(seed).normal(size=(steps, channels)) / np.sqrt(steps), jnp.float32)


def entry(levels: sig.Levels, word: tuple[int, ...]) -> float:
    n = levels[0].shape[0]
    return float(levels[len(word) - 1][int(np.ravel_multi_index(word, (n,) * len(word)))])


def iterated_integral(increments: np.ndarray, word: tuple[int, ...]) -> float:
    """Over the simplex of a piecewise linear path: ordered choices of segments, 1/m! where one is chosen m times."""
    total = 0.0
    for chosen in itertools.combinations_with_replacement(range(len(increments)), len(word)):
        volume = math.prod(1 / math.factorial(chosen.count(i)) for i in set(chosen))
        total += volume * math.prod(increments[i, letter] for i, letter in zip(chosen, word, strict=True))
    return total


@pytest.mark.parametrize("form", [sig.signature, sig.signature_tree])
def test_both_forms_are_the_iterated_integrals(form):
    increments = path(0, 5, 3)
    levels = jax.jit(partial(form, depth=4))(increments)
    exact = np.asarray(increments, np.float64)
    for k in range(1, 5):
        words = itertools.product(range(3), repeat=k)
        np.testing.assert_allclose(levels[k - 1], [iterated_integral(exact, word) for word in words], atol=3e-7)


@pytest.mark.parametrize("form", [sig.signature, sig.signature_tree])
def test_a_straight_line_is_the_exponential_of_its_increment(form):
    x = np.asarray([0.5, -2.0], np.float32)
    levels = form(jnp.tile(jnp.asarray(x) / 8, (8, 1)), 3)
    np.testing.assert_allclose(levels[1], np.kron(x, x) / 2, rtol=1e-5)
    np.testing.assert_allclose(levels[2], np.kron(np.kron(x, x), x) / 6, rtol=1e-5)
    np.testing.assert_allclose(sig.flatten(levels), np.concatenate([x, np.kron(x, x), np.kron(np.kron(x, x), x)]), 1e-5)
    for k, level in enumerate(sig.log(levels)):  # and its logarithm is the increment alone
        np.testing.assert_allclose(level, x if k == 0 else 0 * level, atol=1e-5)


def test_shuffle_identity():
    """S(v) S(w) = sum of S over all shuffles of v and w."""
    levels = sig.signature(path(1, 30, 3), 4)
    for v, w in [((0,), (1,)), ((0, 1), (2,)), ((0, 1), (2, 0)), ((2,), (1, 1, 0)), ((1,), (1,))]:
        length = len(v) + len(w)
        total = 0.0
        for places in itertools.combinations(range(length), len(v)):
            letters_v, letters_w = iter(v), iter(w)
            total += entry(levels, tuple(next(letters_v if i in places else letters_w) for i in range(length)))
        assert entry(levels, v) * entry(levels, w) == pytest.approx(total, abs=2e-6)


def test_chen_identity_and_the_reverse_path_is_the_inverse():
    increments = path(2, 20, 3)
    scan, tree = (jax.jit(partial(form, depth=4)) for form in (sig.signature, sig.signature_tree))
    whole = scan(increments)
    parts = sig.product(scan(increments[:7]), tree(increments[7:]))
    back = sig.product(whole, scan(-increments[::-1]))
    for a, b, nothing in zip(whole, parts, back, strict=True):
        np.testing.assert_allclose(a, b, atol=4e-6)  # float32, in whatever order the compiler adds
        np.testing.assert_allclose(nothing, 0 * nothing, atol=4e-6)


def test_resampling_and_pauses_change_nothing():
    increments = path(3, 6, 2)
    pieces = [(i, share) for i in range(6) for share in ((0.25, 0.75), (0.5, 0.0, 0.5), (1.0,))[i % 3]]
    finer = jnp.stack([increments[i] * np.float32(share) for i, share in pieces])
    for form in (sig.signature, sig.signature_tree):
        for a, b in zip(form(increments, 4), form(finer, 4), strict=True):
            np.testing.assert_allclose(a, b, atol=1e-6)


def test_log_of_two_segments_is_baker_campbell_hausdorff():
    x, y = np.asarray([1.0, 0.5, -1.0]), np.asarray([0.3, -0.8, 2.0])

    def bracket(a, b):
        return np.kron(a, b) - np.kron(b, a)

    levels = sig.log(sig.signature(jnp.asarray(np.stack([x, y]), jnp.float32), 3))
    second = bracket(x, y)
    third = (bracket(x, second) - bracket(y, second)) / 12
    np.testing.assert_allclose(levels[0], x + y, rtol=1e-6)
    np.testing.assert_allclose(levels[1], second / 2, atol=1e-6)
    np.testing.assert_allclose(levels[2], third, atol=2e-6)
    np.testing.assert_allclose(sig.lyndon(levels)[1], second.reshape(3, 3)[np.triu_indices(3, 1)] / 2, atol=1e-6)


@pytest.mark.parametrize(("channels", "depth"), [(1, 3), (2, 6), (3, 4), (5, 3)])
def test_lyndon_words_are_smaller_than_their_rotations(channels, depth):
    found = sig.lyndon_words(channels, depth)
    for k in range(1, depth + 1):
        words = list(itertools.product(range(channels), repeat=k))
        lyndon = [i for i, w in enumerate(words) if all(w < w[j:] + w[:j] for j in range(1, k))]
        np.testing.assert_array_equal(found[k - 1], lyndon)
    assert sum(map(len, found)) == sig.log_size(channels, depth)
    assert sig.size(channels, depth) == sum(channels**k for k in range(1, depth + 1))


def test_lyndon_entries_are_independent_coordinates():
    """Near no motion the map from enough paths to Lyndon entries spans all of them: none is a combination of others."""
    paths = jnp.asarray(np.random.default_rng(4).normal(size=(200, 8, 2)), jnp.float32)
    rows = jax.jit(jax.vmap(lambda p: sig.flatten(sig.lyndon(sig.log(sig.signature(p, 4))))))(paths)
    assert rows.shape == (200, 2 + 1 + 2 + 3)
    assert np.linalg.matrix_rank(np.asarray(rows - rows.mean(axis=0)[None])) == 8


def test_gradients_agree_between_the_forms():
    weights = path(5, 1, sig.size(2, 3))[0]

    def loss(form, increments):
        return sig.flatten(form(increments, 3)) @ weights

    a, b = (jax.jit(jax.grad(partial(loss, form)))(path(6, 9, 2)) for form in (sig.signature, sig.signature_tree))
    np.testing.assert_allclose(a, b, atol=1e-5)
    assert float(jnp.max(jnp.abs(a))) > 1e-3
