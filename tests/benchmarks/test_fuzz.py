"""A few of the inputs and kills of benchmarks/tests/fuzz.py and kills.py, which are run whole by hand."""

import sys
import warnings
from pathlib import Path

import fuzz
import fuzz_cases
import fuzz_files
import fuzz_inputs
import kills
import numpy as np
import pytest


@pytest.mark.parametrize("kind", fuzz_cases.KINDS)
def test_malformed_inputs_are_refused_or_harmless(kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    function, found = fuzz_cases.KINDS[kind][0], []
    for number in range(4):
        folder = tmp_path / str(number)
        folder.mkdir()
        monkeypatch.chdir(folder)
        what, call = function(np.random.default_rng([7, number]), folder)
        found.append((what, *fuzz.outcome(call)))
    assert [case for case in found if case[1] not in fuzz.GOOD] == []


def test_what_the_inputs_are_made_from_is_sound(tmp_path: Path) -> None:
    """Else all of them would be refused for the same reason."""
    from bayessim_mjx.diagnosis.fitting import robot

    rows = [",".join(f"{x:.6g}" for x in row) for row in fuzz_inputs.table()]
    (tmp_path / "run.csv").write_text("\n".join([fuzz_inputs.HEADER, *rows]))
    (tmp_path / "arm.xml").write_text(fuzz_inputs.ARM)
    (tmp_path / "params").write_text(fuzz_inputs.PARAMS)
    (tmp_path / "effects").write_text(fuzz_inputs.EFFECTS)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for name, text in ((None, None), ("run.yaml", fuzz_inputs.SIDE), ("map.yaml", fuzz_inputs.MAP)):
            if name is not None and text is not None:
                (tmp_path / name).write_text(text)
            fuzz_files.read(tmp_path, None)
        body = robot.of_file(tmp_path / "arm.xml", tmp_path / "params")
        fuzz_cases._effects(tmp_path / "effects")
    assert len(body.space) == 3


@pytest.mark.slow  # CI kills whole runs in tests/commands
def test_a_run_that_is_killed_goes_on_bit_for_bit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "argv", ["kills.py", "--kills", "2", "--commands", "train", "--out", str(tmp_path)])
    assert kills.main() == 0
