"""The faults of the benchmark still have their places in the code, each exactly one."""

import ast
import dataclasses
import sys

import mutants
import pytest


def test_there_are_the_thirty_one_of_ppo_and_as_many_others():
    assert [m.number for m in mutants.MUTANTS] == list(range(1, len(mutants.MUTANTS) + 1))
    assert len(mutants.PPO_MUTANTS) == 31 and len(mutants.FAULTS) >= 30 and len(mutants.SILENT) >= 40
    assert sum(m.peer for m in mutants.MUTANTS) == 5


@pytest.mark.parametrize("mutant", mutants.MUTANTS, ids=lambda m: m.fault)
def test_every_edit_applies_and_leaves_a_program(mutant):
    text = (mutants.ROOT / mutant.file).read_text()
    changed = mutants.mutated(text, mutant)
    assert ast.dump(ast.parse(changed)) != ast.dump(ast.parse(text))


def test_every_edit_that_does_not_apply_is_named(monkeypatch, capsys):
    one, *rest = mutants.MUTANTS[:4]
    moved = [dataclasses.replace(one, old="no such line"), dataclasses.replace(one, file="no_such_file.py"), *rest]
    monkeypatch.setattr(mutants, "MUTANTS", moved)
    monkeypatch.setattr(sys, "argv", ["mutants.py", "--check"])
    assert mutants.main() == 1
    first, second, last = capsys.readouterr().err.splitlines()
    assert "'no such line' stands 0 times in " + one.file in first and "no_such_file.py" in second
    assert last == "2 of 5 edits do not apply"


@pytest.mark.parametrize(
    ("end", "did"), [("3 passed, 1 skipped in 2 s", True), ("2 skipped in 1 s", False), ("no tests ran", False)]
)
def test_tests_that_are_all_skipped_did_not_run(end, did):
    assert mutants.ran(end) is did


def test_an_edit_that_does_not_apply_once_is_an_error():
    mutant = mutants.Mutant(1, "fault", "file.py", "a = 1", "a = 2", ())
    assert mutants.mutated("b\na = 1\n", mutant) == "b\na = 2\n"
    for text in ("a = 3", "a = 1\na = 1"):
        with pytest.raises(mutants.Stale, match="'a = 1' stands . times in file.py"):
            mutants.mutated(text, mutant)
