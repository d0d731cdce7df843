"""Every script of the benchmarks says what it is, and stands in the list of them."""

import runpy
import sys
from pathlib import Path

import pytest

BENCHMARKS = Path(__file__).resolve().parents[2] / "benchmarks"
SCRIPTS = [p for p in sorted(BENCHMARKS.glob("*/*.py")) if "__main__" in p.read_text()]


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda p: f"{p.parent.name}/{p.name}")
def test_help_says_what_a_script_does(script, monkeypatch, capsys):
    monkeypatch.syspath_prepend(script.parent)
    monkeypatch.setattr(sys, "argv", [str(script), "--help"])
    with pytest.raises(SystemExit) as end:
        runpy.run_path(str(script), run_name="__main__")
    assert end.value.code in (0, None) and "usage:" in capsys.readouterr().out


def test_the_list_of_scripts_is_whole():
    text = (BENCHMARKS / "README.md").read_text()
    own = {"worker.py"}  # started by blind.py
    assert [p.name for p in SCRIPTS if p.name not in own and f"`{p.name}`" not in text] == []
