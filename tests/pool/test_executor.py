"""One way to run many calls: processes of this machine and Dask's give the same, also where some are killed."""

import argparse
import importlib.util
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from bayessim_mjx import pool
from bayessim_mjx.errors import UserError
from bayessim_mjx.pool.clusters import cluster
from tests.pool import calls

needs_dask = pytest.mark.skipif(
    importlib.util.find_spec("distributed") is None, reason='Dask is missing: pip install "bayessim-mjx[cluster]"'
)
WHERE = ["", pytest.param("local", marks=needs_dask)]


@pytest.mark.parametrize("where", WHERE)
def test_results_are_those_of_the_calls(where: str) -> None:
    with pool.executor(where, 2) as executor:
        assert list(executor.map(calls.square, range(9))) == [x * x for x in range(9)]
        with pytest.raises(ValueError, match="3 is wrong"):
            executor.submit(calls.fails, 3).result()
        assert len({executor.submit(calls.process).result() for _ in range(9)}) <= 2


@pytest.mark.parametrize("where", WHERE)
def test_a_process_that_kills_itself_is_replaced_and_its_call_runs_again(where: str, tmp_path: Path) -> None:
    with pool.executor(where, 2) as executor:
        found = [executor.submit(calls.dies_once, tmp_path, x) for x in range(3)]
        assert [f.result() for f in found] == [0, 1, 4]
    assert len(list(tmp_path.iterdir())) == 3


def test_a_process_that_always_dies_is_an_error(tmp_path: Path) -> None:
    with (
        pool.executor("", 1, folder=tmp_path) as executor,
        pytest.raises(UserError, match="died 4 times.*worker_0.txt"),
    ):
        executor.submit(calls.dies, 1).result()


@needs_dask
def test_a_worker_of_dask_that_always_dies_is_an_error() -> None:
    with pool.executor("local", 1) as executor, pytest.raises(UserError, match="--cluster local: .*dies"):
        executor.submit(calls.dies, 1).result()


@pytest.mark.parametrize("where", WHERE)
def test_who_leaves_by_an_error_waits_for_no_call(where: str, tmp_path: Path) -> None:
    file, started = tmp_path / "process", time.monotonic()
    with pytest.raises(ZeroDivisionError), pool.executor(where, 2) as executor:
        executor.submit(calls.process, 60.0, file)
        _appears(file)
        raise ZeroDivisionError
    assert time.monotonic() - started < 30 and _gone(int(file.read_text()))


def test_the_death_of_one_process_leaves_the_others_at_their_work(tmp_path: Path) -> None:
    with pool.executor("", 2) as executor:
        begun = [executor.submit(calls.process, 3.0, tmp_path / name) for name in "ab"]
        for name in "ab":
            _appears(tmp_path / name)
        before = [int((tmp_path / name).read_text()) for name in "ab"]
        os.kill(before[0], signal.SIGKILL)
        after = [future.result() for future in begun]
    assert after[0] != before[0] and after[1] == before[1]


ENDLESS = """
import sys
from pathlib import Path
from bayessim_mjx import pool
from tests.pool import calls
if __name__ == "__main__":
    with pool.executor("", 1) as executor:
        executor.submit(calls.process, 60.0, Path(sys.argv[1])).result()
"""


def test_processes_end_with_a_pool_that_is_killed(tmp_path: Path) -> None:
    file = tmp_path / "process"
    (tmp_path / "endless.py").write_text(ENDLESS)
    environment = os.environ | {"PYTHONPATH": str(Path(__file__).parents[2])}
    started = subprocess.Popen([sys.executable, tmp_path / "endless.py", file], env=environment)
    _appears(file)
    started.kill()
    started.wait()
    assert _gone(int(file.read_text()))


def _appears(file: Path) -> None:
    end = time.monotonic() + 60
    while not (file.exists() and file.read_text()):
        assert time.monotonic() < end, file
        time.sleep(0.05)


def _gone(process: int) -> bool:
    for _ in range(200):
        try:
            os.kill(process, 0)
        except ProcessLookupError:
            return True
        time.sleep(0.05)
    return False


@pytest.mark.parametrize(
    "text", ["mine", "tcp://host", "tcp://:80", "tcp://host:0", "tcp://host:70000", "slurm:", "http://host:80", "tcp:"]
)
def test_what_is_no_cluster_is_refused_with_what_is_allowed(text: str) -> None:
    with pytest.raises(argparse.ArgumentTypeError, match=f"'{text}': allowed: tcp://HOST:PORT.*slurm:FILE.*or local"):
        cluster(text)


@pytest.mark.parametrize("text", ["", "local", "tcp://10.0.0.1:8786", "tls://head.site:80", "tcp://[::1]:8786"])
def test_what_is_a_cluster_is_taken(text: str) -> None:
    assert cluster(text) == text


def test_a_file_of_settings_has_to_be_there(tmp_path: Path) -> None:
    (tmp_path / "jobs.yaml").write_text("cores: 1\n")
    assert cluster(f"slurm:{tmp_path}/jobs.yaml") == f"slurm:{tmp_path}/jobs.yaml"
    with pytest.raises(argparse.ArgumentTypeError, match="there is no file"):
        cluster(f"slurm:{tmp_path}/no.yaml")


def test_without_the_extra_its_name_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(UserError, match=r'pip install "bayessim-mjx\[cluster\]"'):
        pool.executor("tcp://localhost:8786")


@needs_dask
def test_nobody_answers(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("bayessim_mjx.pool.clusters.PATIENCE", 1)
    with pytest.raises(UserError, match="--cluster tcp://127.0.0.1:9: no Dask scheduler answers"):
        pool.executor("tcp://127.0.0.1:9")
    with pytest.raises(UserError, match="--workers 3"):
        pool.executor("tcp://127.0.0.1:9", 3)


@pytest.mark.skipif(importlib.util.find_spec("dask_jobqueue") is None, reason="dask-jobqueue is missing")
@pytest.mark.parametrize(
    ("settings", "said"),
    [("memory: 1GB\nqeue: x\n", "qeue"), ("- 1\n", "mapping"), ("", "mapping"), ("cores: 1\n", "memory")],
)
def test_settings_of_jobs_that_are_wrong_are_refused(settings: str, said: str, tmp_path: Path) -> None:
    (tmp_path / "jobs.yaml").write_text(settings)
    with pytest.raises(UserError, match=f"--cluster slurm:.*{said}.*allowed: arguments of dask_jobqueue.SLURMCluster"):
        pool.executor(f"slurm:{tmp_path}/jobs.yaml")
