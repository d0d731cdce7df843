"""Effects say themselves what people call them; nothing else in the package lists them."""

import ast
from pathlib import Path

import pytest

import bayessim_mjx
from bayessim_mjx import effects
from bayessim_mjx.effects.support.words import Words, words
from bayessim_mjx.errors import UserError

PACKAGE = Path(bayessim_mjx.__file__).parent
OWN = """
import dataclasses
from typing import ClassVar
from bayessim_mjx.effects.effect import Effect, Quantity


@dataclasses.dataclass(frozen=True)
class GearNoise(Effect):
    {docstring}
    name: ClassVar[str] = "gear_noise"
    kind: ClassVar[str] = "joint"
    quantities: ClassVar[tuple[Quantity, ...]] = (Quantity("size", 0.0, 0.0, 1.0),)
    {words}
"""


def own(folder, docstring="", words=""):
    file = folder / "gears.py"
    file.write_text(OWN.format(docstring=docstring, words=words))
    return effects.load(f"{file}:GearNoise")


@pytest.mark.parametrize("name", effects.names())
def test_every_effect_of_the_library_has_words_of_its_own(name):
    kind, said = effects.load(name), words(name)
    assert kind.noun and kind.separates and said.noun == kind.noun and said.kind == kind.kind
    assert said.lacks == (kind.lacks or kind.noun) and said.witness == kind.witness
    assert kind.lacks != kind.noun  # said once


def test_words_by_hand():
    assert words("actuator_delay").lacks == "a command delay" and words("coulomb_friction").lacks == "Coulomb friction"
    assert words("backlash").witness == ("link", "an encoder on the link side of the gearbox (`link:<joint>`)")
    assert words("an effect from elsewhere") == Words("an effect from elsewhere", lacks="an effect from elsewhere")


def test_an_effect_of_a_user_without_words_is_called_by_its_name_and_told_by_its_docstring(tmp_path):
    own(tmp_path, '"""F = size sin(n q).\n\n    More of it."""')
    told = "a motion that excites its law, F = size sin(n q)"
    assert words("gear_noise") == Words("gear noise", "joint", "gear noise", told)


def test_without_a_docstring_nothing_is_made_up(tmp_path):
    own(tmp_path)
    assert words("gear_noise") == Words("gear noise", "joint", "gear noise")


def test_an_effect_of_a_user_has_its_own_words(tmp_path):
    given = "ripple", "a ripple", "slow turns", ("current", "its current")
    own(tmp_path, words=f"noun, lacks, separates, witness = {given!r}")
    assert words("gear_noise") == Words(given[0], "joint", *given[1:])


@pytest.mark.parametrize(("given", "told"), [("noun = 3", "noun = 3"), ('witness = "imu"', "witness = 'imu'")])
def test_words_that_are_no_texts_are_refused(given, told, tmp_path):
    with pytest.raises(UserError, match=f"{told}: expected "):
        own(tmp_path, words=given)


def test_no_table_of_effects_is_left_outside_their_files():
    """No dictionary has the names of two of the library's effects as keys.

    But for the blind check, whose reality knows nothing of the effects' files.
    """
    names = set(effects.names())
    for file in PACKAGE.rglob("*.py"):
        if file.is_relative_to(PACKAGE / "effects") or file.is_relative_to(PACKAGE / "blind"):
            continue
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
            keys = node.keys if isinstance(node, ast.Dict) else []
            keys = [k.arg for k in node.keywords] if isinstance(node, ast.Call) else keys
            found = {getattr(key, "value", key) for key in keys} & names
            assert len(found) < 2, f"{file}, line {node.lineno}: {found}"
