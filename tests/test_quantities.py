"""A value and its uncertainty end at the same decimal place; the right answers are written down by hand."""

import math

import numpy as np
import pytest

from bayessim_mjx.monitor.words import ascii_of
from bayessim_mjx.quantities import estimate, number, percent


@pytest.mark.parametrize(
    ("value", "uncertainty", "text"),
    [
        (1.04, 0.064, "1.040 ± 0.064"),
        (0.648, 0.17, "0.65 ± 0.17"),
        (-857.06, 45.9, "-857 ± 46"),
        (152.0, 31.0, "152 ± 31"),
        (12345.6, 678.9, "12350 ± 680"),  # both to tens
        (0.5, 0.0996, "0.50 ± 0.10"),  # the uncertainty gains a digit where it is rounded up
        (9.999, 0.99, "10.00 ± 0.99"),
        (-0.001, 0.25, "0.00 ± 0.25"),  # no negative zero
        (0.0, 3.0, "0.0 ± 3.0"),
        (0.1, 250.0, "0 ± 250"),
        (3.2e-6, 4e-7, "(3.20 ± 0.40)·10⁻⁶"),
        (2.5e7, 1.5e6, "(2.50 ± 0.15)·10⁷"),
        (np.float32(0.25), np.float32(0.125), "0.25 ± 0.12"),
        (1.5, 0.0, "1.50"),
        (1.5, math.nan, "1.50"),
        (1.5, 1e-12, "1.50"),
        (math.nan, 0.1, "–"),
    ],
)
def test_value_and_uncertainty(value, uncertainty, text):
    assert estimate(value, uncertainty) == text


def test_one_digit_where_a_line_has_no_room():
    assert estimate(54.7, 2.9, 1) == "55 ± 3" and estimate(95.4, 0.96, 1) == "95 ± 1"


def test_numbers():
    assert [number(v) for v in (0.031234, 9.999, 123456.0, 7, 2.5e-6, None)] == [
        "0.0312", "10.0", "123456", "7", "2.50·10⁻⁶", "–",
    ]  # fmt: skip


def test_in_ascii():
    assert ascii_of(estimate(-3.2e-6, 4e-7)) == "(-3.20 +/- 0.40)*10^-6"


@pytest.mark.parametrize(
    ("share", "text"),
    [
        (0.68, "68 %"), (0.0421, "4.2 %"), (0.00413, "0.41 %"), (0.09, "9.0 %"), (0.0996, "10 %"), (0.9972, "99.7 %"),
        (1.0, "100 %"), (0.0, "0 %"), (-0.2, "-20 %"), (None, "–"),
    ],
)  # fmt: skip
def test_shares(share, text):
    assert percent(share) == text


def test_a_change_has_a_sign():
    assert percent(0.25, sign=True) == "+25 %" and percent(-0.25, sign=True) == "-25 %"
