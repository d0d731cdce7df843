"""The gap by hand: the share that is closed, the residual share, and the noise."""

import math

import pytest

from bayessim_mjx.diagnosis.statistics import AT_NOISE, Gap, of_one, of_rms


@pytest.mark.parametrize(
    ("before", "after", "noise", "closed"),
    [
        (9.0, 3.0, 1.0, 0.75),  # 6 of 8
        (90.0, 30.0, 10.0, 0.75),  # the unit does not matter
        (9.0, 1.0, 1.0, 1.0),
        (9.0, 0.5, 1.0, 1.0),  # nothing undercuts the noise
        (9.0, 9.0, 1.0, 0.0),
        (9.0, 13.0, 1.0, -0.5),  # worse than before
        (3.0, 2.0, 2.5, 1.0),
    ],
)
def test_shares_of_the_squared_gap_above_the_noise(before, after, noise, closed):
    gap = Gap(before, after, noise)
    assert gap.closed == pytest.approx(closed) and gap.left == pytest.approx(1.0 - closed)


@pytest.mark.parametrize("after", [0.5, 1.0, 4.0])
def test_of_no_gap_nobody_closes_a_share(after):
    for before in (0.8, 1.0):
        assert math.isnan(Gap(before, after).closed) and math.isnan(Gap(before, after).left)


def test_a_part_of_the_gap_as_a_share():
    assert Gap(9.0, 3.0).share(2.0) == 0.25
    assert Gap(9.0, 3.0).share(9.0 - 3.0) == Gap(9.0, 3.0).closed


def test_from_root_mean_squares():
    gap = of_rms(10.0, 2.0)
    assert gap.closed == pytest.approx(96 / 99) and gap.rms == 2.0
    assert of_rms(10.0, 4.0, 2.0).rms == 2.0  # in noise standard deviations, of a noise of 2
    assert of_rms(10.0, 4.0, 2.0).closed == pytest.approx(84 / 96)


def test_noise_is_told_by_what_is_left_in_noise_standard_deviations():
    assert of_rms(50.0, AT_NOISE).at_noise and of_rms(50.0, 0.7).at_noise
    assert not of_rms(50.0, 1.01 * AT_NOISE).at_noise
    assert of_one(100 * 1.14**2, 100.0).at_noise and not of_one(100 * 1.16**2, 100.0).at_noise  # sums over windows
