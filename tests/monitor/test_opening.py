"""The lines before a run: parameters that a diagnosis recalibrated and that the task does not randomise."""

from types import SimpleNamespace

import jax
import yaml

from bayessim_mjx import config, registry
from bayessim_mjx.config.loading import replace
from bayessim_mjx.config.settings import Frozen
from bayessim_mjx.monitor.opening import opening
from bayessim_mjx.parameters import ParameterSpace

FOUND = Frozen({
    "name": "pendulum_mass_mult", "low": 0.3, "high": 2.0, "operation": "scaling", "attribute": "mass",
    "target": "pendulum", "kind": "body",
})  # fmt: skip


def test_a_file_of_recalibrated_parameters_alone_says_what_stays_fixed_and_what_draws_it() -> None:
    task = "Pendulum"
    settings = config.load(task)
    fixed = SimpleNamespace(space=ParameterSpace())
    on = Frozen({**settings.randomization, "randomize": True})
    randomised = replace(settings, randomization=on, calibrated=(FOUND,))
    text = opening(randomised, fixed, jax.devices()[0], infers=False)["parameters"]
    assert "no uncertain effects" in text and "pendulum_mass_mult" in text and "--cfg_env FILE" in text
    section = yaml.safe_load(text.split("`")[1])["task"]["randomization_params"]
    model = registry.make(task, config=settings).mj_model
    assert ParameterSpace.from_config(section, model).parameters[0].attribute == "mass"
    assert opening(settings, fixed, jax.devices()[0])["parameters"] == "none"
