"""Files may be anybody's: no code of theirs runs, nothing is read from the environment, and they stay small."""

import os
from pathlib import Path

import pytest

from bayessim_mjx import cli, config, effects, registry, trust
from bayessim_mjx.config import load
from bayessim_mjx.config.yaml_text import read_value, read_yaml, to_yaml
from bayessim_mjx.effects.support import storage
from bayessim_mjx.errors import UserError

EFFECT = """
import dataclasses, pathlib
from typing import ClassVar
from bayessim_mjx.effects.effect import Effect, Quantity
pathlib.Path(__file__ + ".ran").touch()

@dataclasses.dataclass(frozen=True)
class Magnets(Effect):
    name: ClassVar[str] = "magnets"
    kind: ClassVar[str] = "joint"
    quantities: ClassVar[tuple[Quantity, ...]] = (Quantity("pull", 0.0, 0.0, 1.0),)
"""


@pytest.fixture
def code(tmp_path: Path) -> Path:
    (tmp_path / "magnets.py").write_text(EFFECT)
    return tmp_path / "magnets.py"


def ran(code: Path) -> bool:
    return Path(f"{code}.ran").exists()


def settings_naming(code: Path, folder: Path) -> dict[str, dict]:
    """The ways in which files can name code."""
    entry = f"{{effect: '{code}:Magnets', where: hinge}}"
    (folder / "listed.yaml").write_text(f"effects: [{entry}]\n")
    (folder / "effects.yaml").write_text(f"schema: 1\neffects: [{entry}]\n")
    (folder / "file.yaml").write_text(f"effects: '{folder}/effects.yaml'\n")
    group = f"task:\n  randomization_params:\n    effects: {{'{code}:Magnets': {{hinge: {{}}}}}}\n"
    (folder / "group.yaml").write_text(group)
    files = {name: {"cfg_env": folder / f"{name}.yaml"} for name in ("listed", "file", "group")}
    return files | {"override": {"overrides": [f"effects={folder}/effects.yaml"]}}


@pytest.mark.parametrize("way", ["listed", "file", "group", "override"])
def test_code_that_a_file_names_runs_only_if_the_user_names_it_too(way: str, code: Path, tmp_path: Path) -> None:
    given = settings_naming(code, tmp_path)[way]
    with pytest.raises(UserError, match=r"magnets\.py.*runs only where you name it.*--allow_code .*magnets\.py"):
        registry.make("Pendulum", config=load("Pendulum", **given))
    assert not ran(code)
    cli.Parser("main", "").parse(["--allow_code", str(code)])
    env = registry.make("Pendulum", config=load("Pendulum", **given))
    assert ran(code) and env.space.names[-1] == "hinge.magnets.pull"


def test_code_on_the_command_line_runs_and_a_folder_made_so_asks_again(code: Path, tmp_path: Path, monkeypatch) -> None:
    settings = load("Pendulum", overrides=[f"effects=[{{effect: '{code}:Magnets', where: hinge}}]"])
    assert registry.make("Pendulum", config=settings).space.names[-1] == "hinge.magnets.pull"
    (tmp_path / "env.yaml").write_text(to_yaml(settings.to_dict()))  # as a run keeps its settings
    monkeypatch.setattr(trust, "_named", set())  # another process
    with pytest.raises(UserError, match="--allow_code"):
        registry.make("Pendulum", config=load(cfg_env=tmp_path / "env.yaml"))


def test_the_file_that_a_diagnosis_writes_says_which_code_it_needs(code: Path, tmp_path: Path, monkeypatch) -> None:
    effect = effects.make(f"{code}:Magnets", where="hinge")
    written = storage.write(tmp_path / "found.yaml", [effect], {"hinge.magnets.pull": (0.3, 0.01)})
    assert written.read_text().startswith("# ") and f"--allow_code {code}" in written.read_text().splitlines()[0]
    assert storage.read(written).effects  # a program that made it may read it
    monkeypatch.setattr(trust, "_named", set())
    with pytest.raises(UserError, match="--allow_code"):
        storage.read(written)


def test_the_flag_wants_a_file(tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"--allow_code .*nothing\.py: no such file"):
        cli.Parser("main", "").parse(["--allow_code", str(tmp_path / "nothing.py")])


@pytest.mark.parametrize(
    "text",
    [
        "${oc.env:HOME}",
        "x${oc.env:HOME,none}y",
        "${oc.decode:'1'}",
        "${env.${name}}",
        "${oc.create:{}}",
        "\\${oc.env:A}",
    ],
)
def test_no_resolver_runs(text: str, tmp_path: Path) -> None:
    (tmp_path / "f.yaml").write_text(f"name: '{text.replace(chr(39), chr(39) * 2)}'\nenv: {{a: 1}}\n")
    with pytest.raises(UserError, match=r"f\.yaml: .*only references such as \$\{section\.key\}"):
        read_yaml(tmp_path / "f.yaml")
    with pytest.raises(UserError, match="not expanded"):
        load("Pendulum", overrides=[f"name={text}"])
    with pytest.raises(UserError, match="not expanded"):
        load("Pendulum", flags={"--logdir": ("logdir", text)})


def test_references_stand_for_numbers_and_texts(tmp_path: Path) -> None:
    (tmp_path / "f.yaml").write_text("a: {b: [1, 2.5], c: run}\nd: ${a.b.1}\ne: ${a.c}_${a.b.0}\ng: ${d}\n")
    assert read_yaml(tmp_path / "f.yaml") == {"a": {"b": [1, 2.5], "c": "run"}, "d": 2.5, "e": "run_1", "g": 2.5}


NINE = "".join(f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 9)}]\n" for i in range(1, 12))
TEN = "".join(f"t{i}: " + f"${{t{i - 1}}}" * 10 + "\n" for i in range(1, 10))
GROWING = {
    "deep lists": ("a: " + "[" * 5000 + "]" * 5000, "nested more than 50 deep"),
    "deep sections": ("\n".join(" " * i + "a:" for i in range(400)), "nested more than 50 deep"),
    "aliases": ("a0: &a0 [1, 1, 1]\n" + NINE, "by its aliases"),
    "alias of itself": ("a: &a [*a]", "nested more than 50 deep"),
    "references": ("t0: xxxxxxxxxx\n" + TEN, "characters"),
    "circle": ("a: ${b}\nb: ${a}", "in a circle"),
    "section": ("a: {b: 1}\nc: ${a}", "is a section or a list"),
    "large": ("a: " + "x" * 1_100_000, "larger than 1 MB"),
    "python": ("a: !!python/object/apply:os.getcwd []", "not valid YAML: could not determine a constructor"),
    "control": ("a: \x00", "not valid YAML"),
}


@pytest.mark.parametrize("case", GROWING)
def test_what_grows_or_runs_is_one_line(case: str, tmp_path: Path) -> None:
    text, words = GROWING[case]
    (tmp_path / "f.yaml").write_text(text)
    with pytest.raises(UserError, match=rf"f\.yaml.*{words}") as caught:
        read_yaml(tmp_path / "f.yaml")
    assert "\n" not in str(caught.value) and len(str(caught.value)) < 400


def test_neither_pipes_nor_folders_are_read(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe.yaml")
    for path in (tmp_path / "pipe.yaml", tmp_path, Path("/dev/zero")):
        with pytest.raises(UserError, match="cannot be read: not a file"):
            read_yaml(path)


def test_values_of_overrides_are_one_value() -> None:
    texts = ("1e-3", "[1, a]", "{a: 2}", "", "yes", "a b")
    assert [read_value(t, "x") for t in texts] == [1e-3, [1, "a"], {"a": 2}, None, True, "a b"]
    with pytest.raises(UserError, match="nested more than 50 deep"):
        read_value("[" * 5000, "x")
    with pytest.raises(UserError, match=r"expected section\.key=value"):
        load("Pendulum", overrides=[".".join("a" * 3000) + "=1"])
    assert config.load("Pendulum", overrides=["name=a-1"]).name == "a-1"


def test_allowed_files_are_flags_for_the_next_command(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A run of one's own task ends with a command that plays its policy: without the flag it would be refused."""
    monkeypatch.setattr(trust, "_named", set())
    assert trust.flags() == ""
    trust.allow([tmp_path / "my arm.py", tmp_path / "effect.py"])
    assert trust.flags() == f" --allow_code {tmp_path}/effect.py --allow_code '{tmp_path}/my arm.py'"
