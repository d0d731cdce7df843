"""Products of several factors where they lie: what all lean by is found and taken back, what is exact stays."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from bayessim_mjx.distributions import Distribution
from bayessim_mjx.inference import local_recalibration, product_calibration
from bayessim_mjx.parameters import Parameter, ParameterSpace

SPACE = ParameterSpace([Parameter(name, 0.0, -1.0, 1.0) for name in "ab"])
SD, COUNT, MANY = 0.1, 8, 48
CORNER, LEANS = 0.7, 1.5  # beyond it, the network's means are so many SD too low in the first parameter


def leaning(thetas, seed):
    """Factors of sets at `thetas` [m, 2], by a network that is exact but beyond CORNER."""
    rng = np.random.default_rng(seed)
    off = np.where(thetas[:, :1] > CORNER, [[-LEANS * SD, 0.0]], 0.0)
    means = (thetas + off)[:, None] + SD * rng.normal(size=(len(thetas), COUNT, 2))
    scale = np.eye(2)[None] * SD / 2
    return [[Distribution.from_unit(SPACE, np.zeros(1), (m[None] + 1) / 2, scale) for m in each] for each in means]


@pytest.mark.parametrize("truth", [0.95, -0.5])
@pytest.mark.slow
def test_sets_at_draws_of_the_posterior_take_back_what_the_network_leans_by_there(truth):
    """In a corner that hardly any draw of the prior reaches, products are sqrt(8) LEANS = 4.2 of their SD too low."""
    everywhere = np.random.default_rng(0).uniform(-1, CORNER, (MANY, 2))
    found = product_calibration.judge(leaning(everywhere, 1), everywhere, components=1)
    at, mean = jnp.asarray([truth, 0.0]), np.array([truth - LEANS * SD * (truth > CORNER), 0.0])
    scale = np.eye(2)[None] * SD / 2 / COUNT**0.5
    product = Distribution.from_unit(SPACE, np.zeros(1), (mean[None] + 1) / 2, scale)

    def drawn(posterior, turn):
        thetas = np.asarray(posterior.sample(jax.random.PRNGKey(turn), MANY))
        return leaning(thetas, 2 + turn), thetas

    here = local_recalibration.recalibrated(found, product, drawn, components=1)
    used = here.used(product, COUNT)
    assert here.counts == found.counts and here.widening(COUNT) < 1.3
    before, after = (float(q.credible_level(at)) for q in (found.used(product, COUNT), used))
    if truth > CORNER:
        # SD 0.1 and its eighth of a variance, in unit coordinates
        np.testing.assert_allclose(here.move, [LEANS * SD / 2, 0.0], atol=3 * SD / 2 / (COUNT * MANY) ** 0.5)
        assert before > 0.999 and after < 0.5 and "is moved by that bias" in here.sentence()
        again = [local_recalibration.count(*drawn(used, t), 1, here.move, here.widening(COUNT)) for t in (9, 10, 11)]
        for level in (0.5, 0.8, 0.95):  # sets that did not choose it; standard errors up to .04
            assert np.mean([a.coverage(level) for a in again]) == pytest.approx(level, abs=0.13)
    else:
        assert here.move is None and len(here.near) == 1 and after == pytest.approx(before, abs=0.2)
    assert local_recalibration.recalibrated(found, product, lambda posterior, turn: None, components=1) == found
    np.testing.assert_allclose(found.used(product, 4).means, product.means)  # of fewer it tells nothing


def test_a_mean_error_is_what_is_beyond_chance_and_few_sets_tell_none():
    rng = np.random.default_rng(0)
    errors = rng.normal(size=(400, 64, 5))
    told = np.mean([local_recalibration.mean_error(each)[0] is not None for each in errors])
    assert told < 0.03  # one in a hundred
    move, cov = local_recalibration.mean_error(errors[0] + np.array([3.0, 0, 0, 0, 0]))
    np.testing.assert_allclose(move, [3.0, 0, 0, 0, 0], atol=0.45)
    np.testing.assert_allclose(cov, np.eye(5), atol=0.6)
    assert local_recalibration.mean_error(errors[0, :5] + 3.0)[0] is None


def test_nothing_is_moved_out_of_the_box():
    q = Distribution.from_unit(SPACE, np.zeros(1), np.full((1, 2), 0.5), np.eye(2)[None] * 0.05)
    assert product_calibration.moved(q, np.array([5.0, 0.0])) is q
    np.testing.assert_allclose(product_calibration.moved(q, np.array([0.2, 0.0])).means, [[0.7, 0.5]], rtol=1e-6)


def test_parameters_that_are_not_identified_keep_no_other_from_being_moved():
    """Their Gaussians, 20 ranges wide, have all but no mass in the box: log mass -47 for twelve of them."""
    space = ParameterSpace([Parameter(f"t{i}", 0.0, -1.0, 1.0) for i in range(13)])
    scale = np.diag([0.05] + [20.0] * 12)[None]
    q = Distribution.from_unit(space, np.zeros(1), np.full((1, 13), 0.5), scale)
    assert float(q.log_inside) < 1.3 * product_calibration.ROUNDED
    np.testing.assert_allclose(
        product_calibration.moved(q, np.array([0.2] + [0.0] * 12)).means[0, :2], [0.7, 0.5], rtol=1e-6
    )


def test_sets_are_judged_by_moves_that_they_had_no_part_in():
    """24 sets in 8 dimensions, exact but for a common shift of 5 SD. Moved back by the mean of 24 errors their squares
    are 1 - 1/24 where they chose it, and 1 + 1/21 where 21 others did: 8/2 times the difference is .36 nats.
    """
    space = ParameterSpace([Parameter(f"p{k}", 0.0, -1.0, 1.0) for k in range(8)])
    rng, sd, plain = np.random.default_rng(0), 0.02, []
    for _ in range(30):
        thetas = rng.uniform(-0.3, 0.3, (24, 8))
        means = 0.5 * (thetas + 1) + 5 * sd + sd * rng.normal(size=thetas.shape)
        rows = [[Distribution.from_unit(space, np.zeros(1), m[None], sd * np.eye(8)[None])] for m in means]
        count, move, _ = local_recalibration.judged(rows, thetas, 1, None)
        np.testing.assert_allclose(move, -5 * sd, atol=4 * sd / 24**0.5)
        plain.append(count.plain)
    at_the_truth = -8 * np.log(np.sqrt(2 * np.pi) * sd)
    held_out = at_the_truth - 4 * (1 + 1 / 21)
    assert np.mean(plain) == pytest.approx(held_out, abs=0.25)  # standard error .08
    assert np.mean(plain) < at_the_truth - 4 * (1 - 1 / 24) - 0.15


def test_turns_that_end_without_an_answer_say_so(monkeypatch):
    found = product_calibration.Sets((product_calibration.Count(2, 1.0, 1.0, 0.1, 1.0, np.linspace(0, 1, 8)),))
    product = Distribution.from_unit(SPACE, np.zeros(1), np.full((1, 2), 0.5), 0.05 * np.eye(2)[None])
    never = [replace(found.counts[0], widening=2.0 + k) for k in range(local_recalibration.TURNS)]
    turns = iter(never)
    monkeypatch.setattr(local_recalibration, "judged", lambda *a: (next(turns), None, True))
    here = local_recalibration.recalibrated(
        found, product, lambda posterior, turn: ([], np.zeros((0, 2))), components=1
    )
    assert not here.settled and "needed more" in here.sentence() and here.to_dict()["settled"] is False
    assert here.widening(2) == local_recalibration.TURNS + 1
    monkeypatch.setattr(local_recalibration, "judged", lambda *a: (found.counts[0], None, True))
    assert local_recalibration.recalibrated(
        found, product, lambda posterior, turn: ([], np.zeros((0, 2))), components=1
    ).settled
