"""Cases that are under way at a time share the cores out."""

import itertools
import os

import pytest

from bayessim_mjx.blind.plan import AT_ONCE, known, rounds
from bayessim_mjx.blind.runner import shares


@pytest.mark.parametrize(("cores", "workers"), [(64, 32), (64, 30), (16, 3), (2, 2)])
def test_each_core_is_one_workers_and_none_is_idle(cores: int, workers: int) -> None:
    given = shares(range(cores), workers)
    assert sorted(itertools.chain(*given)) == list(range(cores))
    sizes = {len(own) for own in given}
    assert len(given) == workers and max(sizes) - min(sizes) <= 1


def test_one_worker_or_too_many_stay_on_no_core() -> None:
    assert shares(range(8), 1) == [[]]
    assert shares(range(2), 3) == [[], [], []]


def test_so_many_cases_need_not_wait_for_any_other() -> None:
    waiting = [own for own in rounds(100) if known(own)]
    assert waiting[0].start == AT_ONCE


@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="this system pins no process to cores")
def test_a_worker_stays_on_its_cores(tmp_path) -> None:
    """It says so itself, as its diagnoses would."""
    import json
    import subprocess
    import sys

    from bayessim_mjx.blind.check import Check
    from bayessim_mjx.blind.worker import asked

    core = min(os.sched_getaffinity(0))
    code = "import os, runpy, sys\ntry: runpy.run_module('bayessim_mjx.blind.worker', run_name='__main__')\n"
    code += "except SystemExit: print(sorted(os.sched_getaffinity(0)), file=sys.stderr)"
    words = asked(Check(str(tmp_path), task="Pendulum"), [core])
    ended = subprocess.run([sys.executable, "-c", code], input=words + "\n", capture_output=True, text=True, check=True)
    assert json.loads(ended.stderr.splitlines()[-1]) == [core]
