"""The faults of the benchmark still have their places in the code, each exactly one."""

import ast
import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "benchmarks" / "tests"))
mutants = pytest.importorskip("mutants")


def test_there_are_the_thirty_one_of_ppo_and_as_many_others():
    assert [m.number for m in mutants.MUTANTS] == list(range(1, len(mutants.MUTANTS) + 1))
    assert len(mutants.PPO_MUTANTS) == 31 and len(mutants.FAULTS) >= 30
    assert sum(m.peer for m in mutants.MUTANTS) == 5


@pytest.mark.parametrize("mutant", mutants.MUTANTS, ids=lambda m: m.fault)
def test_every_edit_applies_and_leaves_a_program(mutant):
    text = (mutants.ROOT / mutant.file).read_text()
    changed = mutants.mutated(text, mutant)
    assert ast.dump(ast.parse(changed)) != ast.dump(ast.parse(text))


def test_an_edit_that_does_not_apply_once_is_an_error():
    mutant = mutants.Mutant(1, "fault", "file.py", "a = 1", "a = 2", ())
    assert mutants.mutated("b\na = 1\n", mutant) == "b\na = 2\n"
    for text in ("a = 3", "a = 1\na = 1"):
        with pytest.raises(mutants.Stale, match="'a = 1' stands . times in file.py"):
            mutants.mutated(text, mutant)
