"""A task's ranges come from its file, those of a class without a file from its base's."""

import pytest

from bayessim_mjx import registry
from bayessim_mjx.config.loading import OfFile
from bayessim_mjx.tasks.pendulum import Pendulum


def test_ranges_stand_in_the_file_alone():
    assert vars(Pendulum).keys().isdisjoint({"randomization", "real_parameters"})
    assert Pendulum.randomization["randomization_params"]["actor_params"]["pendulum"]["rigid_body_properties"]["mass"][
        "range"
    ] == (0.01, 2.0)
    assert Pendulum.real_parameters == (1.0, 0.5)


def test_a_subclass_without_a_file_takes_its_bases():
    class Standing(Pendulum):
        pass

    assert Standing().space == registry.make("Pendulum").space and Standing.real_parameters == (1.0, 0.5)


def test_a_class_without_any_file_says_so():
    class Alone:
        ranges = OfFile("task")

    assert not hasattr(Alone, "ranges")
    with pytest.raises(AttributeError, match=r"Alone has no ranges: .*cfg/alone.yaml gives none"):
        _ = Alone().ranges
