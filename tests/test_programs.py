"""Programs that are kept: traced once for the same model and shapes, anew for any other, and never stale."""

import importlib.util
import sys

import mujoco
import numpy as np
import pytest

from bayessim_mjx import programs
from bayessim_mjx.effects import make
from bayessim_mjx.effects.actuator_gain import ActuatorGain
from bayessim_mjx.parameters import ParameterSpace
from bayessim_mjx.physics import Physics

XML = """<mujoco><worldbody><body><joint name="a" type="slide"/><geom size=".1" mass="%g"/></body></worldbody>
<actuator><motor name="m" joint="a"/></actuator></mujoco>"""


@pytest.fixture(autouse=True)
def own_cache(tmp_path, monkeypatch):
    monkeypatch.setenv("BAYESSIM_MJX_CACHE", str(tmp_path))
    return tmp_path / programs.FOLDER


def counted(factor=2.0):
    traced = []

    def function(pair, x):
        traced.append(1)
        return {"y": factor * pair["a"] @ x, "z": None}

    return function, traced


GIVEN = {"a": np.arange(6.0, dtype=np.float32).reshape(2, 3)}, np.ones(3, np.float32)


def test_a_second_process_need_not_trace(own_cache):
    first, traced = counted()
    assert programs.Kept(first, "key")(*GIVEN)["y"] == pytest.approx([6.0, 24.0])
    assert len(traced) == 1 and len(list(own_cache.iterdir())) == 1
    second, again = counted()
    kept = programs.Kept(second, "key")
    assert kept(*GIVEN)["y"] == pytest.approx([6.0, 24.0]) and kept(*GIVEN)["z"] is None
    assert not again and kept.count == 1


@pytest.mark.parametrize("other", ["key", "shape", "type"])
def test_another_key_shape_or_type_is_another_program(other):
    first, _ = counted()
    programs.Kept(first, "key")(*GIVEN)
    second, traced = counted(3.0)
    a, x = GIVEN
    given = {"key": (a, x), "shape": ({"a": a["a"][:1]}, x), "type": (a, x.astype(np.int32))}[other]
    y = programs.Kept(second, "another" if other == "key" else "key")(*given)["y"]
    assert len(traced) == 1 and float(y[0]) == 9.0


def test_half_a_file_is_made_anew(own_cache):
    first, _ = counted()
    programs.Kept(first, "key")(*GIVEN)
    (path,) = own_cache.iterdir()
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    second, traced = counted()
    assert programs.Kept(second, "key")(*GIVEN)["y"] == pytest.approx([6.0, 24.0])
    assert len(traced) == 1 and len(path.read_bytes()) > len(whole) // 2


def test_nothing_is_kept_without_a_cache_or_of_what_nobody_can_tell(own_cache, monkeypatch):
    first, _ = counted()
    programs.Kept(first, None)(*GIVEN)
    monkeypatch.setenv("BAYESSIM_MJX_CACHE", "off")
    assert programs.Kept(first, "key")(*GIVEN)["y"] == pytest.approx([6.0, 24.0])
    assert not own_cache.exists()


def physics(mass=1.0, effects=(), **other):
    return Physics(mujoco.MjModel.from_xml_string(XML % mass), 0.02, ParameterSpace(), effects, **other)


def test_a_physics_is_known_by_its_model_its_effects_and_their_ranges():
    every = [
        physics(),
        physics(1.1),
        physics(effects=[make("actuator_gain", where="m")]),
        physics(effects=[make("actuator_delay", where="m")]),
        physics(effects=[make("actuator_delay", where="m", high=0.05)]),
        physics(max_qvel=3.0),
        physics(unroll=True),
    ]
    names = [programs.traced_from(p) for p in every]
    assert len({*names}) == len(every)
    assert programs.traced_from(physics(1.1)) == names[1]
    assert programs.traced_from(every[0], "another program") != names[0]


def test_effects_of_ones_own_are_known_by_their_file(tmp_path, monkeypatch):
    path = tmp_path / "own_effect.py"

    def digest(text):
        path.write_text(f"from bayessim_mjx.effects.actuator_gain import ActuatorGain\n{text}")
        spec = importlib.util.spec_from_file_location("own_effect", path)
        module = importlib.util.module_from_spec(spec)
        monkeypatch.setitem(sys.modules, "own_effect", module)
        spec.loader.exec_module(module)
        return programs.traced_from(physics(effects=[module.Own(where="m")]))

    one = digest("class Own(ActuatorGain):\n    pass\n")
    two = digest("class Own(ActuatorGain):\n    factor = 2\n")
    assert one and two and one != two
    typed = type("Typed", (ActuatorGain,), {"__module__": "typed_in_a_shell"})
    assert programs.traced_from(physics(effects=[typed(where="m")])) is None
