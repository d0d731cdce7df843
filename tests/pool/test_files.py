"""The files of examples/cluster do what they say, here with a process of this machine for each container and task."""

import importlib.util
import json
import os
import socket
import subprocess
import sys
from pathlib import Path

import pytest
import yaml

from tests.blind.recorded import pendulum

ROOT = Path(__file__).parents[2]
FILES = ROOT / "examples" / "cluster"
ENTRY = ROOT / "tests" / "blind" / "entry.py"
PROGRAMS = {"bayessim-mjx": [sys.executable, "-m", "bayessim_mjx"], "dask": [sys.executable, "-m", "dask"]}
TINY = ["--task", "Pendulum", "--num_envs", "64", "--max_iterations", "1", "--device", "cpu", "ppo.num_steps=8"]
needs_dask = pytest.mark.skipif(
    importlib.util.find_spec("distributed") is None, reason='Dask is missing: pip install "bayessim-mjx[cluster]"'
)


def containers() -> dict[str, dict]:
    """{name of a Deployment or Job: its only container}."""
    documents = yaml.safe_load_all((FILES / "kubernetes.yaml").read_text())
    kept = [d for d in documents if d["kind"] in ("Deployment", "Job")]
    return {d["metadata"]["name"]: d["spec"]["template"]["spec"]["containers"][0] for d in kept}


def free_port() -> int:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        return free.getsockname()[1]


def start(container: dict, changes: dict[str, str], *more: str, **variables: str) -> subprocess.Popen:
    """A container's command with its variables, after replacements in its words."""

    def changed(text: str) -> str:
        for old, new in changes.items():
            text = text.replace(old, new)
        return text

    program, *words = map(changed, container["command"])
    given = {v["name"]: changed(v["value"]) for v in container.get("env", ()) if "value" in v}
    environment = os.environ | {"PYTHONPATH": str(ROOT), "JAX_PLATFORMS": "cpu"} | given | variables
    return subprocess.Popen([*PROGRAMS[program], *words, *more], env=environment, stderr=subprocess.PIPE, text=True)


@needs_dask
@pytest.mark.slow
@pytest.mark.ci
def test_a_blind_check_on_kubernetes(tmp_path: Path) -> None:
    shared, port = pendulum(tmp_path / "shared"), str(free_port())
    (shared / "model.xml").rename(shared / "robot.xml")
    changes = {"/shared": str(shared), "tcp://scheduler": "tcp://127.0.0.1", "8786": port}
    entry = f"{sys.executable} {ENTRY} {shared}/blind/sealed 8 {{data}} {{out}}"
    found = containers()
    servers = [start(found[name], changes) for name in ("scheduler", "workers", "workers")]
    try:
        blind = start(found["blind"], changes, "--cases", "3", "--no_sandbox", "--command", entry)
        said = blind.communicate(timeout=280)[1]
    finally:
        for server in servers:
            server.terminate()
            server.communicate()
    assert blind.returncode == 0, said
    assert json.loads((shared / "blind" / "blind.json").read_text())["cases"] == 3


@pytest.mark.slow
def test_a_training_on_kubernetes(tmp_path: Path) -> None:
    container = containers()["train"]
    index = next(v for v in container["env"] if v["name"] == "JAX_PROCESS_ID")
    assert (
        "job-completion-index" in index["valueFrom"]["fieldRef"]["fieldPath"]
    )  # what Kubernetes counts, the test does
    changes = {"train-0.train:1234": f"127.0.0.1:{free_port()}", "/shared": str(tmp_path)}
    both = [start(container, changes, *TINY, JAX_PROCESS_ID=str(i)) for i in range(2)]
    ended(both, tmp_path / "logs")


SRUN = """#!/bin/bash
for i in 0 1; do SLURM_PROCID=$i SLURM_LOCALID=0 "$@" & done
wait -n && wait -n
"""


@pytest.mark.slow
def test_a_training_on_slurm(tmp_path: Path) -> None:
    """With a stand-in for srun, which gives each task its variables as Slurm does on two nodes."""
    programs = tmp_path / "bin"
    programs.mkdir()
    own = f'exec {" ".join(PROGRAMS["bayessim-mjx"])} "$@"'
    for name, text in {
        "srun": SRUN,
        "scontrol": "#!/bin/sh\necho localhost\n",
        "bayessim-mjx": f"#!/bin/sh\n{own}\n",
    }.items():
        (programs / name).write_text(text)
        (programs / name).chmod(0o755)
    slurm = {"JOB_ID": str(free_port() - 20000), "NTASKS": "2", "JOB_NODELIST": "a,b", "STEP_NODELIST": "a,b"}
    environment = os.environ | {f"SLURM_{k}": v for k, v in slurm.items()} | {
        "PATH": f"{programs}:{os.environ['PATH']}", "PYTHONPATH": str(ROOT), "JAX_PLATFORMS": "cpu",
    }  # fmt: skip
    words = ["bash", FILES / "train.sbatch", *TINY, "--headless", "--logdir", tmp_path / "logs"]
    running = subprocess.Popen(words, env=environment, stderr=subprocess.PIPE, text=True)
    ended([running], tmp_path / "logs")


def ended(processes: list[subprocess.Popen], logs: Path) -> None:
    """All of them end well, and one has written a policy."""
    said = [p.communicate(timeout=600)[1] for p in processes]
    assert [p.returncode for p in processes] == [0] * len(processes), said
    assert len(list(logs.glob("Pendulum/*/checkpoints/*"))) >= 1


def test_settings_of_jobs_are_those_of_dask_jobqueue() -> None:
    jobs = pytest.importorskip("dask_jobqueue", reason='pip install "bayessim-mjx[cluster]"')
    settings = yaml.safe_load((FILES / "jobs.yaml").read_text()) | {"cores": 1, "processes": 1}
    script = jobs.SLURMCluster.job_cls(scheduler="tcp://head:8786", name="a", **settings).job_script()
    assert "#SBATCH --cpus-per-task=4" in script and "--nthreads 1" in script and "-p main" in script
