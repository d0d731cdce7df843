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
