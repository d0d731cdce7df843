"""What a run sets and what the inference room takes by itself have one source."""

import dataclasses
import typing

import numpy as np
import pytest

from bayessim_mjx.config import BayesSimConfig
from bayessim_mjx.errors import UserError
from bayessim_mjx.inference import InferenceSettings

OWN, RUN = ({f.name: f for f in dataclasses.fields(kind)} for kind in (InferenceSettings, BayesSimConfig))
SHARED = [name for name in OWN if name in RUN]


def test_shared_settings_have_the_default_meaning_and_limits_of_the_run():
    assert set(SHARED) == {
        "modelClass", "components", "fullCovariance", "hiddenLayers", "lr", "coordinates", "ensemble",
    }  # fmt: skip
    hints = typing.get_type_hints(InferenceSettings), typing.get_type_hints(BayesSimConfig)
    for name in SHARED:
        assert OWN[name].default is RUN[name].default
        assert dict(OWN[name].metadata) == dict(RUN[name].metadata)
        assert hints[0][name] == hints[1][name]


def test_a_run_says_what_the_room_would_take():
    assert InferenceSettings.of(BayesSimConfig()) == InferenceSettings()
    given = BayesSimConfig(components=3, hiddenLayers=(8,), coordinates="logit", checkTrajs=0)
    settings = InferenceSettings.of(given, batch=32)
    assert (settings.components, settings.hiddenLayers, settings.chart, settings.batch) == (3, (8,), "logit", 32)


@pytest.mark.parametrize("name", ["components", "lr", "ensemble", "hiddenLayers"])
def test_what_one_refuses_the_other_refuses(name):
    value = (0,) if name == "hiddenLayers" else 0
    words = rf"{name} = 0(\.0)?: must be (at least 1|greater than 0)"
    for kind in (InferenceSettings, BayesSimConfig):
        with pytest.raises(UserError, match=words):
            kind(**{name: value})


def test_its_own_limits_hold_and_numbers_of_arrays_are_numbers():
    settings = InferenceSettings(components=np.int64(3), lr=np.float32(0.5), hiddenLayers=[4, 4])
    assert (settings.components, settings.lr, settings.hiddenLayers) == (3, 0.5, (4, 4))
    assert hash(settings) == hash(InferenceSettings(components=3, lr=0.5, hiddenLayers=(4, 4)))
    for name, value in {"validation": 1.0, "dropout": 1.0, "batch": 0, "grad_clip": 0.0, "clip": -1.0}.items():
        with pytest.raises(UserError, match=f"{name} = {value}: must be"):
            InferenceSettings(**{name: value})
