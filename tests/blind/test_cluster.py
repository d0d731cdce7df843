"""A blind check by a cluster: the cases are those of one machine, also where workers and schedulers are killed."""

import contextlib
import importlib.util
import os
import random
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from bayessim_mjx.blind import process
from tests.blind.recorded import pendulum

ROOT = Path(__file__).parents[2]
ENTRY = Path(__file__).with_name("entry.py")
ENVIRONMENT = os.environ | {"PYTHONPATH": str(ROOT)}
pytestmark = [pytest.mark.slow, pytest.mark.ci]
needs_dask = pytest.mark.skipif(
    importlib.util.find_spec("distributed") is None, reason='Dask is missing: pip install "bayessim-mjx[cluster]"'
)


def started(*words: object) -> subprocess.Popen:
    return subprocess.Popen([sys.executable, "-m", *map(str, words)], env=ENVIRONMENT, stderr=subprocess.PIPE)


@contextlib.contextmanager
def cluster(workers: int) -> Iterator[tuple[str, subprocess.Popen, subprocess.Popen]]:
    """Dask as its user starts it: (address, the scheduler, the workers' nannies)."""
    scheduler = started("dask", "scheduler", "--host", "127.0.0.1", "--port", 0, "--no-dashboard")
    lines = iter(scheduler.stderr.readline, b"")
    address = next(line.split()[-1].decode() for line in lines if b"Scheduler at" in line)
    options = ("--nworkers", workers, "--nthreads", 1, "--no-dashboard", "--death-timeout", 20)
    own = started("dask", "worker", address, *options)
    own.stderr.close()
    try:
        yield address, scheduler, own
    finally:
        for each in (own, scheduler):
            each.terminate()
            each.wait()


def check(folder: Path, out: Path, *more: object) -> subprocess.Popen:
    entry = f"{sys.executable} {ENTRY} {out / 'sealed'} 8 {{data}} {{out}}"
    robot = ("--model", folder / "model.xml", "--data", folder / "logs", "--out", out, "--headless", "--no_sandbox")
    hidden = ("--effects", "viscous_friction,actuator_bias", "--cases", 10, "--command", entry)
    return started("bayessim_mjx.blind_check", *robot, *hidden, *more)


def ended(running: subprocess.Popen) -> tuple[int, str]:
    _, said = running.communicate(timeout=300)
    return running.returncode, said.decode()


def answers(out: Path) -> dict[str, bytes]:
    """What is hidden and what was said of it."""
    paths = [*out.glob("cases/*/seal.txt"), *out.glob("sealed/*"), *out.glob("cases/*/answer/diagnosis.json")]
    return {str(p.relative_to(out)): p.read_bytes() for p in paths}


def finished(out: Path) -> int:
    return len(list(out.glob("cases/*/answer/exit.json")))


def until_finished(out: Path, count: int) -> None:
    end = time.monotonic() + 200
    while finished(out) < count:
        assert time.monotonic() < end
        time.sleep(0.02)


def processes_of(parent: int, words: str) -> list[int]:
    """Processes that this one has started and that have these words in their command."""
    children = " ".join(f.read_text() for f in Path(f"/proc/{parent}/task").glob("*/children")).split()
    return [int(c) for c in children if words in Path(f"/proc/{c}/cmdline").read_text()]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return pendulum(tmp_path_factory.mktemp("robot"))


@pytest.fixture(scope="module")
def undisturbed(folder: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    out = tmp_path_factory.mktemp("local") / "out"
    assert ended(check(folder, out, "--workers", 2))[0] == 0
    found = answers(out)
    assert len(found) == 30
    return found


def kill_at_random(parent: int, out: Path, seed: int = 0) -> None:
    """Three workers, one after the other, at any time of their cases."""
    rng = random.Random(seed)
    for count in (1, 3, 5):
        until_finished(out, count)
        time.sleep(rng.uniform(0, 0.5))
        while not (there := processes_of(parent, "spawn_main")):
            time.sleep(0.02)
        os.kill(rng.choice(there), signal.SIGKILL)


@pytest.mark.skipif(not Path("/proc/self/task").exists(), reason="this system does not list processes")
def test_three_processes_killed_at_random_lose_nothing(folder, undisturbed, tmp_path):
    running = check(folder, tmp_path / "out", "--workers", 2)
    kill_at_random(running.pid, tmp_path / "out")
    assert ended(running)[0] == 0
    assert answers(tmp_path / "out") == undisturbed


@needs_dask
def test_three_workers_of_dask_killed_at_random_lose_nothing(folder, undisturbed, tmp_path):
    with cluster(2) as (address, _, own):
        running = check(folder, tmp_path / "out", "--cluster", address)
        kill_at_random(own.pid, tmp_path / "out")
        assert ended(running)[0] == 0
    assert answers(tmp_path / "out") == undisturbed


@needs_dask
def test_a_scheduler_that_is_killed_leaves_what_was_finished(folder, undisturbed, tmp_path):
    out = tmp_path / "out"
    with cluster(2) as (address, scheduler, _):
        running = check(folder, out, "--cluster", address)
        until_finished(out, 3)
        scheduler.kill()
        code, said = ended(running)
    assert code == 2 and f"--cluster {address}: the scheduler is gone" in said
    kept = {p: p.stat().st_mtime_ns for p in out.glob("cases/*/answer/exit.json")}
    assert 3 <= len(kept) < 10
    with cluster(2) as (address, _, _):
        assert ended(check(folder, out, "--cluster", address))[0] == 0
    assert {p: p.stat().st_mtime_ns for p in kept} == kept  # none was made again
    assert answers(out) == undisturbed


def test_a_check_that_is_killed_leaves_what_was_finished(folder, undisturbed, tmp_path):
    running = check(folder, tmp_path / "out", "--workers", 2)
    until_finished(tmp_path / "out", 3)
    running.kill()
    running.wait()
    assert ended(check(folder, tmp_path / "out", "--workers", 2))[0] == 0
    assert answers(tmp_path / "out") == undisturbed


PRYING = """
import json, pathlib, socket, sys
out, sealed, port = pathlib.Path(sys.argv[1]), pathlib.Path(sys.argv[2]), int(sys.argv[3])
for name, way in (("read", lambda: [p.read_text() for p in sealed.iterdir()]),
                  ("connect", lambda: socket.create_connection(("127.0.0.1", port)))):
    try:
        way()
        print(name, "worked")
    except PermissionError:
        print(name, "refused")
out.mkdir()
(out / "diagnosis.json").write_text(json.dumps({"verdict": "no_gap", "effects": []}))
"""


@needs_dask
@pytest.mark.skipif(not process.apart(), reason="this system has no Landlock")
def test_truths_are_sealed_on_workers(folder, tmp_path):
    """Neither the file can be read, nor a worker be had that would read it."""
    out, prying = tmp_path / "out", tmp_path / "prying.py"
    prying.write_text(PRYING)
    with cluster(1) as (address, _, _):
        words = f"{sys.executable} {prying} {{out}} {out / 'sealed'} {address.rpartition(':')[2]}"
        robot = ("--model", folder / "model.xml", "--data", folder / "logs", "--out", out, "--headless")
        running = started("bayessim_mjx.blind_check", *robot, "--cases", 2, "--command", words, "--cluster", address)
        code, said = ended(running)
    assert code == 0, said
    from bayessim_mjx.blind import confine

    connected = "refused" if confine.version() >= 4 else "worked"  # Linux 6.7
    for file in out.glob("cases/*/answer/output.txt"):
        assert file.read_text().split("\n") == ["read refused", f"connect {connected}", ""]
