"""Processes of a pool share the cores out."""

import itertools
import os
import subprocess
import sys

import pytest

from bayessim_mjx.blind.cases import AT_ONCE, known, rounds
from bayessim_mjx.pool.cores import Cores, lent, move, shares


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


def test_cores_of_who_waits_go_to_who_works() -> None:
    own = shares(range(12), 4)
    assert lent(own, range(4)) == dict(enumerate(own))
    assert lent(own, [1, 3]) == {1: [3, 4, 5, 0, 1, 2], 3: [9, 10, 11, 6, 7, 8]}
    assert lent(own, [2]) == {2: [6, 7, 8, 0, 1, 2, 3, 4, 5, 9, 10, 11]}
    assert lent(own, []) == {}


def test_a_single_core_goes_to_one_of_those_who_work() -> None:
    given = lent([[0], [1], [2], [3]], [0, 1, 2])
    assert sorted(itertools.chain(*given.values())) == [0, 1, 2, 3]


moves = pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="this system pins no process to cores")
STARTS = """
import subprocess, sys, threading
child = subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE)
thread = threading.Thread(target=child.wait)
thread.start()
print(child.pid, thread.native_id, flush=True)
input()
child.communicate(b"\\n")
"""


@moves
def test_processes_are_moved_with_all_that_they_started() -> None:
    before = os.sched_getaffinity(0)
    core = max(before)
    process = subprocess.Popen([sys.executable, "-c", STARTS], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    assert process.stdout
    tasks = [process.pid, *map(int, process.stdout.readline().split())]
    move(process.pid, [core])
    found = [os.sched_getaffinity(task) for task in tasks]
    process.communicate("\n")
    assert found == [{core}] * 3
    assert os.sched_getaffinity(0) == before


@moves
def test_a_process_that_ended_is_no_error() -> None:
    process = subprocess.Popen([sys.executable, "-c", ""])
    process.wait()
    move(process.pid, [0])


@moves
def test_who_begins_to_work_gets_its_own_cores_back(monkeypatch: pytest.MonkeyPatch) -> None:
    moved = list[tuple[int, list[int]]]()
    monkeypatch.setattr("bayessim_mjx.pool.cores.move", lambda process, cores: moved.append((process, list(cores))))
    cores = Cores([[0, 1], [2, 3]])
    cores.working(0, 70)
    cores.working(1, 71)
    cores.working(1, None)
    cores.working(0, None)
    assert moved == [(70, [0, 1, 2, 3]), (70, [0, 1]), (71, [2, 3]), (70, [0, 1, 2, 3])]
    assert cores.environment() == {"NPROC": "4"}


def test_workers_without_cores_of_their_own_stay_where_they_are(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("bayessim_mjx.pool.cores.move", lambda process, cores: pytest.fail("moved"))
    cores = Cores(shares(range(2), 3))
    cores.working(0, 70)
    assert cores.environment() == {}
