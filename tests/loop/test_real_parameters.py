"""What `env.realParams` may be: everything else is one line with the key, the value and what is allowed."""

import numpy as np
import pytest

from bayessim_mjx.errors import UserError
from bayessim_mjx.loop.sources import real_parameters
from bayessim_mjx.parameters import Parameter, ParameterSpace

SPACE = ParameterSpace([Parameter("mass", 1.0, 0.1, 2.0), Parameter("length", 1.0, 0.1, 2.0)])
ROWS = "expected one row per component, a list of numbers for mass, length"
MEANS = {"means": [[1.0, 0.5]]}


def test_lists_mappings_and_one_standard_deviation_are_rows():
    weights, means, sds = real_parameters(
        {"means": [["1e0", 0.5], {"length": 1, "mass": 2}], "stds": [[0.1], 2 * [0]]}, SPACE
    )
    np.testing.assert_allclose(weights, [0.5, 0.5])
    np.testing.assert_allclose(means, [[1, 0.5], [2, 1]])
    np.testing.assert_allclose(sds, [[0.1, 0.1], [0, 0]], atol=1e-7)
    np.testing.assert_array_equal(real_parameters(MEANS, SPACE)[2], [[0, 0]])


def test_the_ends_of_a_range_are_in_it():
    """Also those that no float32 is equal to."""
    low, high = 0.1, 0.7
    space = ParameterSpace([Parameter("mass", 0.5, low, high), Parameter("length", 0.5, low, high)])
    np.testing.assert_array_equal(real_parameters({"means": [[low, high]]}, space)[1], np.float32([[low, high]]))


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"means": 5}, rf"realParams\.means = 5: {ROWS}"),
        ({"means": []}, rf"realParams\.means = \[\]: {ROWS}"),
        ({"means": None}, rf"realParams\.means = None: {ROWS}"),
        ({"means": "a"}, rf"realParams\.means = 'a': {ROWS}"),
        ({"means": [[]]}, rf"realParams\.means\[0\] = \[\]: {ROWS}"),
        ({"means": [1.0, [0.5]]}, rf"realParams\.means\[0\] = 1\.0: {ROWS}"),
        ({"means": [[1.0]]}, r"realParams\.means\[0\] has 1 number, the task has 2 parameters: mass, length"),
        ({"means": [[1.0, 1.0, 1.0]]}, r"means\[0\] has 3 numbers, the task has 2 parameters: mass, length"),
        ({"means": [["a", 1.0]]}, r"realParams\.means\[0\]\[0\] = 'a': expected a number"),
        ({"means": {"mass": "a", "length": 1}}, r"realParams\.means\[0\]\.mass = 'a': expected a number"),
        ({"means": [[True, 1.0]]}, r"means\[0\]\[0\] = True: expected a number"),
        ({"means": [[float("nan"), 1.0]]}, r"means\[0\]\[0\] = nan: expected a number"),
        ({"stds": [[0.1]]}, rf"means is missing \(there is only stds\): {ROWS}"),
        (MEANS | {"stds": None}, rf"realParams\.stds = None: {ROWS}"),
        (MEANS | {"weights": 1}, r"weights = 1: expected a list of one number >= 0 per row"),
        (MEANS | {"weights": ["a"]}, r"weights\[0\] = 'a': expected a number"),
        (MEANS | {"weights": [-1]}, r"must be >= 0"),
    ],
)
def test_refusals_name_key_value_and_what_is_allowed(settings, words):
    with pytest.raises(UserError, match=words):
        real_parameters(settings, SPACE)
