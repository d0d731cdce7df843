"""README and docs name only flags, settings, files and links that exist."""

import contextlib
import dataclasses
import importlib
import io
import re
from pathlib import Path

import pytest

from bayessim_mjx.config import settings

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
COMMANDS = ("main", "train", "play", "calibrate", "diagnose", "gap_loop")
OTHERS = {"--logdir", "--samples_per_plugin"}  # tensorboard's
PYTHON = {"env.py", "env.reset", "env.step", "env.dt", "env.mj_model", "ppo.train"}  # in Python, not settings


@pytest.fixture(scope="module")
def flags():
    text = io.StringIO()
    for name in COMMANDS:
        with contextlib.redirect_stdout(text):
            importlib.import_module(f"bayessim_mjx.{name}").main(["--help"])
    return set(re.findall(r"--[a-z_]+", text.getvalue())) | OTHERS


def keys():
    """`section.key` of every setting; sections within sections by their prefix."""
    found = set()
    for thing in vars(settings).values():
        if dataclasses.is_dataclass(thing) and getattr(thing, "SECTION", ""):
            found |= {f"{thing.SECTION}.{field.name}" for field in dataclasses.fields(thing)}
    return found | {"env.maxEpisodeLength"}  # BayesSimIG's other name of env.episodeLength


@pytest.mark.parametrize("page", PAGES, ids=lambda p: p.name)
def test_what_a_page_names_exists(page, flags):
    text, known = page.read_text(), keys()
    assert set(re.findall(r"--[a-z_]+", text)) <= flags
    named = set(re.findall(r"\b((?:bayessim|ppo|monitor|env|real)\.[a-zA-Z_]+)\b", text)) - PYTHON
    assert {name for name in named if name not in known} == set()
    links = [link for link in re.findall(r"\]\(([^)#]+)", text) if not link.startswith("http")]
    files = re.findall(r"`((?:examples|benchmarks|tests|docs|cfg)/[\w/.]+\.(?:py|md|yaml))`", text)
    assert [x for x in links if not (page.parent / x).exists()] + [x for x in files if not (ROOT / x).exists()] == []
