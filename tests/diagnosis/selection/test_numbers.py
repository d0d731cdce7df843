"""The page of the numbers has every one with its value, and what is derived from them follows."""

import dataclasses
import math
import re
from pathlib import Path

import pytest

from bayessim_mjx.diagnosis.selection import numbers

PAGE = Path(__file__).parents[3] / "docs" / "decisions" / "numbers.md"


def test_every_number_is_in_the_table_with_its_value():
    rows = re.findall(r"^\| `([\w.]+)` \| ([^|]+) \|", PAGE.read_text(encoding="utf-8"), re.M)
    shown = {name: [float(x) for x in values.split(",")] for name, values in rows}
    own = {"HIDDEN": [numbers.HIDDEN], "FLOOR": [numbers.FLOOR]}
    for group in (numbers.PRIORS, numbers.RELEVANCE, numbers.ODDS, numbers.EFFORT):
        for field in dataclasses.fields(group):
            value = getattr(group, field.name)
            own[f"{type(group).__name__}.{field.name}"] = list(value) if isinstance(value, tuple) else [value]
    assert shown == own


def test_the_prior_of_the_missing_force_has_both_ends_two_deviations_off():
    p = numbers.Priors(least=1e-4)
    ends = [math.exp(math.log(p.usual) + sign * 2 * p.spread) for sign in (-1, 1)]
    assert ends == pytest.approx([1e-4, 1.0])


def test_a_look_simulates_as_many_starting_points_as_windows():
    effort = numbers.Effort(sets=(3, 2), windows=20)
    assert effort.batch == 5 and effort.points == 4
