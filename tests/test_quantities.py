"""Numbers, shares, units, durations and counts; the right answers are written down by hand."""

import math

import numpy as np
import pytest

from bayessim_mjx.quantities import (
    ascii_of,
    compact,
    count,
    duration,
    estimate,
    extent,
    is_number,
    listed,
    number,
    percent,
    percent_estimate,
    size,
    typeset,
    unit,
)


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


def test_a_share_with_its_uncertainty():
    assert percent_estimate(0.93, 0.012) == "93.0 ± 1.2 %" and percent_estimate(0.93, 0.012, 1) == "93 ± 1 %"


def test_compact_numbers_and_durations():
    assert [compact(v) for v in (0.0123456, 12345.6, 2.5e6, 3, -1e9)] == ["0.01235", "12.35k", "2.5M", "3", "-1000M"]
    assert compact(12345.6, 3) == "12.3k" and compact(math.inf) == "inf"
    assert [duration(v) for v in (3.21, 42, 59.9, 125, 7300, None)] == [
        "3.2 s", "42 s", "59 s", "2 min 05 s", "2 h 01 min", "?",
    ]  # fmt: skip


def test_counts_and_sizes():
    assert [count(n, "log") for n in (0, 1, 2)] == ["0 logs", "1 log", "2 logs"]
    assert [size(n) for n in (1.25e13, 2e9, 3.456e6, 999.0)] == ["12.5 TB", "2 GB", "3.46 MB", "999 bytes"]


def test_names_in_a_sentence():
    assert listed([]) == "" and listed(["a"]) == "a" and listed(["a", "b", "c"], "or") == "a, b or c"
    assert listed(["a", "b", "c"], most=3) == "a, b and c"
    assert listed(["a", "b", "c"], most=1) == "a and 2 more" and listed("abcdef", most=2) == "a, b and 4 more"


def test_lengths_and_angles_in_the_units_of_a_workshop():
    # 0.0087 rad = 0.498 deg
    assert extent(0.0087, "rad") == "0.50 deg" and extent(0.0012, "m") == "1.2 mm" and extent(2.5, "m") == "2.5 m"


def test_units_and_signs_as_printed():
    assert unit("N m s^2/rad^2") == "N m s²/rad²" and typeset("-1.5") == "−1.5"


def test_what_can_be_told_as_a_number():
    assert [v for v in (1, np.float32(2.5), math.inf) if is_number(v)] == [1, 2.5, math.inf]
    assert not any(map(is_number, (None, math.nan, "3", [1])))
