"""Effects that users bring: from a file, or installed under an entry point."""

import importlib.metadata
import re
from pathlib import Path

import numpy as np
import pytest

from bayessim_mjx import config, effects, registry
from bayessim_mjx.effects.support import reading, storage
from bayessim_mjx.errors import UserError
from bayessim_mjx.physics import control_step

DOCS = Path(__file__).parents[2] / "docs" / "own_effect.md"


@pytest.fixture(scope="module")
def source():
    """The example of the documentation."""
    text = re.findall(r"```python\n(.*?)```", DOCS.read_text(encoding="utf-8"), re.DOTALL)[0]
    assert len(text.splitlines()) <= 28
    return text


@pytest.fixture
def file(tmp_path, source):
    (tmp_path / "magnets.py").write_text(source)
    return tmp_path / "magnets.py"


@pytest.mark.slow
@pytest.mark.ci
def test_a_file_is_loaded_simulated_and_named_by_its_name(file):
    spec = f"{file}:Magnets"
    kind = effects.load(spec)
    assert kind is effects.load(spec) and kind.name == "magnets"
    effect = effects.make(spec, where="hinge", poles=6.0)
    assert effect == effects.make(spec, where=["hinge"][0], poles=6.0) and effects.spec_of(effect) == spec
    env = registry.make("Pendulum", effects=[effect])
    assert env.space.names[-1] == "hinge.magnets.pull"
    theta = env.space.vector({"hinge.magnets.pull": 0.5})
    start = env.physics.world(theta, np.float32([0.1]), np.float32([0.0]))
    moved, _ = control_step(env.physics, start, np.zeros(1))
    # w = dt (m g l / 2 sin q - pull sin(6 q)) / (m l^2 / 3)
    assert float(moved.qvel[0]) == pytest.approx(0.05 * 3 * (5 * np.sin(0.1) - 0.5 * np.sin(0.6)), rel=1e-4)


def test_settings_name_it_by_file_and_then_by_name(file, monkeypatch):
    monkeypatch.chdir(file.parent)
    listed = "effects=[{effect: magnets.py:Magnets, where: hinge}]"
    settings = config.load(
        "Pendulum", overrides=[listed, "task.randomization_params.effects.magnets.hinge.pull.range=[0, 0.2]"]
    )
    monkeypatch.chdir("/")  # the path means the same from any folder
    env = registry.make("Pendulum", config=settings)
    assert env.space.names[-1] == "hinge.magnets.pull" and env.space.high[-1] == np.float32(0.2)
    assert len(env.physics.effects) == 1


def test_it_goes_through_an_effects_file(file, tmp_path):
    effect = effects.make(f"{file}:Magnets", where="hinge", poles=4.0)
    written = storage.write(tmp_path / "effects.yaml", [effect], {"hinge.magnets.pull": (0.3, 0.01)})
    (found,) = storage.read(written).effects
    assert type(found) is type(effect) and found.poles == 4.0 and found.space().nominal[0] == np.float32(0.3)


def test_a_changed_file_is_read_again(file, source):
    old = effects.load(f"{file}:Magnets")
    file.write_text(source.replace("0.5)", "0.7)") + "\n")
    assert effects.load(f"{file}:Magnets").quantities[0].reach == (0.0, 0.7) and old.quantities[0].reach == (0.0, 0.5)


BAD = {
    "Magnet": ({}, r"magnets\.py:Magnet: no class 'Magnet' in the file; its effects: Magnets"),
    "Quantity": ({}, r"magnets\.py:Quantity: .* is no subclass of bayessim_mjx\.effects\.Effect"),
    "jnt": ({"import jax.numpy": "import jax.nmpy"}, r"magnets\.py, line 6: ModuleNotFoundError: No module named"),
    "syntax": ({"class Magnets(": "class Magnets("[:-1] + "["}, r"magnets\.py, line \d+: SyntaxError: "),
    "name": ({'name: ClassVar[str] = "magnets"': ""}, r"the class lacks `name: ClassVar`"),
    "kind": ({'kind: ClassVar[str] = "joint"': ""}, r"the class lacks `kind: ClassVar` \(one of actuator, joint"),
    "motor": ({'"joint"': '"motor"'}, r"kind = 'motor': allowed are actuator, joint"),
    "empty": ({"(\n        Quantity": "() or (\n        "}, r"magnets\.py, line \d+: "),
    "clash": ({'"magnets"': '"armature"'}, r"there is an effect 'armature' already; give the class another name"),
    "spaces": ({'"magnets"': '"my magnets"'}, r"name = 'my magnets': expected one word"),
    "exit": ({"import jax.numpy": "import sys; sys.exit()\nimport jax.numpy"}, r"magnets\.py, line 6: SystemExit: "),
    "frozen": ({"@dataclasses.dataclass(frozen=True)": ""}, r"the class lacks @dataclasses\.dataclass\(frozen=True\)"),
}


@pytest.mark.parametrize("case", BAD)
def test_what_does_not_keep_the_contract_is_refused_in_one_line(case, file, source):
    changes, words = BAD[case]
    for old, new in changes.items():
        assert old in source
        source = source.replace(old, new)
    file.write_text(source)
    with pytest.raises(UserError, match=words) as caught:
        effects.load(f"{file}:{'Magnets' if changes else case}")
    assert "\n" not in str(caught.value)


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(UserError, match=r"no file .*nothing\.py"):
        effects.load(f"{tmp_path}/nothing.py:Magnets")
    with pytest.raises(UserError, match=r"effects\[0\]: .*no file nothing\.py \(from "):
        settings = [{"effect": "nothing.py:Magnets", "where": "all"}]
        reading.listed(settings)


def installed(monkeypatch, **points):
    found = [importlib.metadata.EntryPoint(k, v, effects.ENTRY_POINTS) for k, v in points.items()]
    monkeypatch.setattr(importlib.metadata, "entry_points", lambda group: found)


def test_installed_effects_are_found_by_entry_point(monkeypatch, file):
    monkeypatch.syspath_prepend(file.parent)
    installed(monkeypatch, magnets="magnets:Magnets", nothing="no_such_package:X", other="magnets:Magnets")
    assert "magnets" in effects.names() and "coulomb_friction" in effects.names()
    effect = effects.make("magnets", where="hinge")
    assert effect.name == "magnets" and effects.spec_of(effect) == "magnets"
    with pytest.raises(UserError, match="effect 'nothing': its package cannot be imported: No module named"):
        effects.load("nothing")
    with pytest.raises(UserError, match="effect other: the class calls itself 'magnets'"):
        effects.load("other")
    with pytest.raises(UserError, match="there is an effect 'magnets' already"):
        effects.load(f"{file}:Magnets")


HOOK = "        return memory, at.scatter(-pull * jnp.sin(self.poles * step.qpos[at.qadr]))\n"
BAD_HOOKS = {
    "raises": ("        return memory, undefined\n", r"on_force fails \(.*magnets\.py, line 25\): NameError: "),
    "exits": ("        raise SystemExit(0)\n", r"on_force fails \(.*magnets\.py, line 25\): SystemExit"),
    "returns nothing": ("", r"on_force returns nothing \(a missing return\?\); expected \(memory, an array \[1\]\)"),
    "forgets the memory": (HOOK.replace("memory, ", ""), r"on_force returns an array \[1\]; expected \(memory"),
    "another shape": (
        "        return memory, pull[:, None]\n",
        r"its result is an array \[1, 1\]; expected an array \[1\]",
    ),
    "is not neutral": (HOOK.replace("-pull", "0.5 - pull"), r"at the neutral values on_force changes its input"),
    "is not finite": (HOOK.replace("-pull", "pull / (1 - pull)"), r"not finite at the highest values of its ranges"),
}


@pytest.mark.parametrize("case", BAD_HOOKS)
def test_a_hook_that_does_not_keep_the_contract_is_refused(case, file, source):
    new, words = BAD_HOOKS[case]
    assert HOOK.strip() in source
    file.write_text(source.replace(HOOK.rstrip("\n"), new.rstrip("\n")))
    with pytest.raises(UserError, match=words) as caught:
        registry.make("Pendulum", effects=[effects.make(f"{file}:Magnets", where="hinge")])
    assert "\n" not in str(caught.value) and "effect magnets" in str(caught.value)
