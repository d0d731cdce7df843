"""What tests of commands share: no cache, a folder of their own, every task the toy where they ask for it."""

from pathlib import Path

import pytest

from bayessim_mjx import registry


@pytest.fixture(autouse=True)
def quiet(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("BAYESSIM_MJX_CACHE", "off")
    monkeypatch.delenv("BAYESSIM_MJX_DEBUG", raising=False)
    monkeypatch.chdir(tmp_path)


@pytest.fixture
def toy(monkeypatch: pytest.MonkeyPatch) -> None:
    """Every task is the toy."""
    from tests.commands.toy_runs import TOY

    monkeypatch.setattr(registry, "make", lambda name, **_: TOY)
