"""The table of contents: every public name is there, and none is imported before it is used."""

import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

import bayessim_mjx


def test_every_public_name_can_be_had():
    for name in bayessim_mjx.__all__:
        assert getattr(bayessim_mjx, name) is not None
    with pytest.raises(AttributeError, match="ParameterSpace"):
        _ = bayessim_mjx.ParamSpace


def test_importing_the_package_imports_neither_jax_nor_mujoco():
    code = "import sys, bayessim_mjx.cli; sys.exit(bool({'jax', 'mujoco'} & set(sys.modules)))"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_tasks_are_not_importable_by_their_plain_name():
    assert "tasks" not in sys.modules and "cfg" not in sys.modules


def test_the_repository_has_one_address():
    root = Path(__file__).parents[1]
    urls = tomllib.loads((root / "pyproject.toml").read_text(encoding="utf-8"))["project"]["urls"]
    for name in ("pyproject.toml", "CITATION.cff", "mkdocs.yml", "bayessim_mjx/rl/hub.py"):
        text = (root / name).read_text(encoding="utf-8")
        assert set(re.findall(r"https://github\.com/[\w-]+/bayessim_mjx", text)) == {urls["Homepage"]}, name
    assert f"site_url: {urls['Documentation']}\n" in (root / "mkdocs.yml").read_text(encoding="utf-8")


def test_the_lock_file_has_what_the_package_asks_for():
    """As `uv lock --check` has it for names, extras and limits."""
    root = Path(__file__).parents[1]
    project = tomllib.loads((root / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    asked = {_asked(text) for text in project["dependencies"]}
    for extra, texts in project["optional-dependencies"].items():
        asked |= {_asked(text, extra) for text in texts}
    lock = tomllib.loads((root / "uv.lock").read_text(encoding="utf-8"))
    own = next(p for p in lock["package"] if p["name"] == project["name"])
    kept = own["metadata"]["requires-dist"]
    marker = lambda row: re.sub(r"extra == '(.*)'", r"\1", row.get("marker", ""))  # noqa: E731
    assert {(r["name"], ",".join(r.get("extras", ())), r["specifier"], marker(r)) for r in kept} == asked
    assert {(p["name"], extra) for extra, rows in own["optional-dependencies"].items() for p in rows} == {
        (name, extra) for name, _, _, extra in asked if extra
    }
    assert own["version"] == project["version"]


def test_the_command_that_the_end_of_a_run_suggests_is_installed_by_default():
    root = Path(__file__).parents[1]
    project = tomllib.loads((root / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    sources = [*(root / "bayessim_mjx").glob("*.py"), *(root / "bayessim_mjx/cli").glob("*.py")]
    texts = "".join(file.read_text(encoding="utf-8") for file in sources)
    suggested = re.findall(r"console\.command\([^,]*, f\"(\S+) ", texts)
    suggested = {word for word in suggested if word != "{cli.prog_of('play')}"}
    assert suggested == {"tensorboard"} and "tensorboard" in {_asked(text)[0] for text in project["dependencies"]}


def _asked(text, extra=""):
    """(name, extras, limits, extra of ours) of a requirement; limits as uv writes them, the lower one first."""
    name, extras, limits = re.match(r"([\w.-]+)(?:\[(.*)\])?(.*)", text).groups()
    return name.lower().replace("_", "-"), extras or "", limits, extra


def test_completion_offers_the_public_names():
    """They are imported when first used; without this `bayessim_mjx.<TAB>` offers what happens to be imported."""
    assert {*bayessim_mjx.__all__} == {*dir(bayessim_mjx)} and "diagnose" in dir(bayessim_mjx)
