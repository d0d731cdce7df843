"""Summaries and densities that users bring: by a call, or installed under an entry point."""

import importlib.metadata
import re
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from bayessim_mjx.config import BayesSimConfig
from bayessim_mjx.config.names import DENSITIES, SUMMARIES
from bayessim_mjx.errors import UserError
from bayessim_mjx.inference import InferenceSettings, densities, fit, infer, init, mdn, summaries
from bayessim_mjx.inference.summarizers import feature_names, get, size, stream
from bayessim_mjx.loop.collection import SummaryInputs
from bayessim_mjx.parameters import Parameter, ParameterSpace

PAGE = Path(__file__).parents[2] / "docs" / "own_summary.md"
STATES, ACTIONS = jnp.asarray([[0.0, 1.0], [1.0, 1.0], [3.0, 0.0], [6.0, 0.0]]), jnp.asarray([[1.0], [2.0], [-1.0]])


@pytest.fixture(autouse=True)
def forgotten(monkeypatch):
    """What a test registers is gone after it."""
    for names in (SUMMARIES, DENSITIES):
        monkeypatch.setattr(names, "_entries", dict(names._entries))


@pytest.fixture
def page(monkeypatch):
    """What the how-to registers."""
    found: dict = {}
    for block in re.findall(r"```python\n(.*?)```", PAGE.read_text(), re.DOTALL):
        exec(block, found)
    return found


def installed(monkeypatch, group, **points):
    found = [importlib.metadata.EntryPoint(k, v, group) for k, v in points.items()]
    monkeypatch.setattr(importlib.metadata, "entry_points", lambda group: [p for p in found if p.group == group])


def test_every_name_of_the_library_has_its_entry():
    for name in SUMMARIES.library:
        entry, options = summaries.entry(name)
        assert (entry.name, options) == (name, {}) and entry.names is not None
    for name in DENSITIES.library:
        assert densities.density_of(InferenceSettings(modelClass=name)).name == name


def test_the_summary_of_the_how_to(page):
    settings = BayesSimConfig(summarizerFxn="energy_2")
    assert settings.summarizerFxn == "summary_energy_2"
    np.testing.assert_allclose(get(settings.summarizerFxn)(STATES, ACTIONS), [0.5, 1.0, 22.5, 0.0])
    ended = get("energy_2")(STATES, ACTIONS, jnp.asarray([1.0, 0.0, 0.0]))  # it stands still from the second state on
    np.testing.assert_allclose(ended, [0.5, 1.0, 1.0, 1.0])
    assert size(get("energy_3"), 20, 4, 2) == 12
    seen = SummaryInputs(3, ("angle", "speed"), ("torque",))
    assert seen.features("energy") == ("mean square of angle, part 1", "mean square of speed, part 1")
    assert seen.embedding("energy") is None
    with pytest.raises(UserError, match="summary_energy has no streaming form; corr, corrdiff"):
        stream("energy", 3, 2, 1)


def test_what_a_summary_does_not_say_is_numbered_and_what_it_says_wrongly_is_told():
    summaries.register(summaries.Summary("summary_last", lambda states, actions, valid=None: states[-1]))
    assert feature_names("last", 3, ("a", "b"), ("c",)) == ("last 1", "last 2")
    with pytest.raises(UserError, match="bayessim.summarizerFxn = 'summary_last_2': summary_last takes no number"):
        BayesSimConfig(summarizerFxn="last_2")
    wrong = {
        "gives a matrix": (lambda states, actions, valid=None: states, lambda *_: ["a"], r"one row of features \[D\]"),
        "miscounts": (lambda states, actions, valid=None: states[0], lambda *_: ["a"], "names 1 features and gives 2"),
        "fails": (lambda states, actions, valid=None: states[9:][0], lambda *_: ["a"], "summary_bad fails on .* 3 st"),
    }
    for function, names, words in wrong.values():
        summaries.register(summaries.Summary("summary_bad", function, names=names))
        with pytest.raises(UserError, match=words):
            feature_names("bad", 3, ("a", "b"), ("c",))


def test_names_that_are_taken_or_none_are_refused():
    with pytest.raises(UserError, match="summary 'energy': the name has to match summary_"):
        summaries.register(summaries.Summary("energy", get("corr")))
    with pytest.raises(UserError, match="the library has one of that name; there are summary_start"):
        summaries.register(summaries.Summary("summary_corr", get("start"), "lags"))
    with pytest.raises(UserError, match="density 'my_own': the name has to match"):
        densities.register(densities.Density("my_own", lambda *_: ({}, (1,)), lambda params, x, drop: x))


def test_installed_ones_are_found_by_entry_point(page, monkeypatch, tmp_path):
    blocks = re.findall(r"```python\n(.*?)```", PAGE.read_text(), re.DOTALL)
    unregistered = "\n".join(re.sub(r"^\w+\.register.*$", "", block, flags=re.MULTILINE) for block in blocks)
    (tmp_path / "my_package.py").write_text(unregistered)
    monkeypatch.syspath_prepend(tmp_path)
    for names in (SUMMARIES, DENSITIES):
        monkeypatch.setattr(names, "_entries", {k: v for k, v in names._entries.items() if k in names.library})
    with pytest.raises(UserError, match="allowed are summary_start"):
        BayesSimConfig(summarizerFxn="energy")
    points = dict(summary_energy="my_package:ENERGY", summary_other="my_package:ENERGY", summary_none="nowhere:X")
    installed(monkeypatch, SUMMARIES.group, **points)
    assert summaries.names()[-3:] == list(points)
    assert BayesSimConfig(summarizerFxn="energy_2").summarizerFxn == "summary_energy_2"
    assert get("energy_2")(STATES, ACTIONS).shape == (4,)
    with pytest.raises(UserError, match="summary 'summary_none': its package cannot be imported: No module"):
        get("none")
    with pytest.raises(UserError, match="summary 'summary_other': its entry point gives .* no summary called so"):
        get("other")
    installed(monkeypatch, DENSITIES.group, SQUARES="my_package:SQUARES")
    assert densities.density_of(InferenceSettings(modelClass="SQUARES")).regressed


def test_a_density_of_ones_own_is_the_network_and_its_ending_is_read(page):
    with pytest.raises(UserError, match="modelClass = 'SQUARES_2': allowed are MDNN, MDRFF.*, SQUARES; and"):
        BayesSimConfig(modelClass="SQUARES_2")

    def power(ending):
        if ending not in ("2", "3"):
            raise ValueError("the power is 2 or 3")
        return int(ending)

    def start(key, settings, dim_x):
        return {"scale": jnp.full(dim_x, float(settings.density[1])), "kept": jnp.ones(1)}, (dim_x, 5)

    def hidden(params, x, drop):
        (layer,) = params["layers"][:-1]
        return jnp.tanh(params["scale"] * x @ layer["w"] + layer["b"])

    densities.register(densities.Density("MINE", start, hidden, power, fixed=("kept",)))
    with pytest.raises(UserError, match="bayessim.modelClass = 'MINE_4': the power is 2 or 3"):
        BayesSimConfig(modelClass="MINE_4")
    settings = InferenceSettings(modelClass="MINE_3", components=2)
    params = mdn.init(jax.random.PRNGKey(0), settings, 4, 2)
    assert settings.density == ("MINE", 3) and "kept" in mdn.fixed(settings)
    assert [layer["w"].shape for layer in params["layers"]] == [(4, 5), (5, mdn.head_size(2, settings))]
    assert mdn.log_prob(params, jnp.ones((3, 4)), jnp.zeros((3, 2)), settings).shape == (3,)
    taken = densities.Density("TAKEN", lambda *_: ({"skip": 1.0}, (2,)), hidden)
    densities.register(taken)
    with pytest.raises(UserError, match="density 'TAKEN': its parameters are skip; names that the network has for"):
        mdn.init(jax.random.PRNGKey(0), InferenceSettings(modelClass="TAKEN"), 4, 2)


@pytest.mark.slow
@pytest.mark.ci
def test_a_density_of_ones_own_learns_what_only_it_can_start_from(page):
    """x^2 + N(0, 0.01^2) is the parameter: a regression on the squares knows it at once, one on x alone nothing."""
    space = ParameterSpace([Parameter("a", 0.5, 0.0, 1.0)])
    x = jax.random.uniform(jax.random.PRNGKey(0), (1000, 1), minval=-1.0)
    thetas = jnp.clip(x**2 + 0.01 * jax.random.normal(jax.random.PRNGKey(1), x.shape), 0, 1)
    settings = InferenceSettings(modelClass="SQUARES", components=1, min_steps=40, max_steps=40, ensemble=1)
    state, info = fit(jax.random.PRNGKey(2), init(jax.random.PRNGKey(3), settings, space, 1), thetas, x)
    posterior = infer(state, jnp.asarray([[-0.7]]))
    assert float(posterior.mean()[0]) == pytest.approx(0.49, abs=0.01)
    assert float(posterior.sd()[0]) < 0.03 and float(info.gain) > 2.0
