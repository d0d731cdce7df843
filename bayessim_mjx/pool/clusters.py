"""Dask's processes, on one machine or many, as a `concurrent.futures.Executor`: pip install "bayessim-mjx[cluster]"."""

import argparse
import contextlib
import re
from collections.abc import Callable
from concurrent.futures import CancelledError, Future
from pathlib import Path
from typing import Any

import yaml

from bayessim_mjx import device
from bayessim_mjx.errors import UserError
from bayessim_mjx.pool.processes import Stopping

FLAG = "--cluster"
HELP = (
    "Dask does the work: tcp://HOST:PORT of a scheduler, slurm:FILE with the settings of Slurm jobs, or local "
    "(default: processes of this machine)"
)
ALLOWED = "tcp://HOST:PORT of a Dask scheduler, slurm:FILE with settings of its jobs, or local; see docs/cluster.md"
ADDRESS = re.compile(r"(?:tcp|tls)://(?:[\w.-]+|\[[0-9a-fA-F:]+\]):(\d{1,5})")
PATIENCE = 30  # s, in which a scheduler has to answer; Dask's `distributed.comm.timeouts.connect`


def cluster(text: str) -> str:
    """Check a value of --cluster, for a parser of flags.

    Raises:
        argparse.ArgumentTypeError: it is none of those allowed, or there is no such file.
    """
    address = ADDRESS.fullmatch(text)
    if text in ("", "local") or (address and 0 < int(address[1]) < 2**16):
        return text
    kind, _, file = text.partition(":")
    if kind != "slurm" or not file:
        raise argparse.ArgumentTypeError(f"{text!r}: allowed: {ALLOWED}")
    if not Path(file).is_file():
        raise argparse.ArgumentTypeError(f"{text!r}: there is no file {file}; allowed: {ALLOWED}")
    return text


CLUSTER: dict[str, Any] = {"metavar": "WHERE", "type": cluster, "default": "", "help": HELP}  # of the flag --cluster


class Dask(Stopping):
    """Calls by a Dask client.

    Args:
        where: what the user gave, for messages; client: a `distributed.Client`; own: the cluster, if it ends with us.
    """

    def __init__(self, where: str, client: Any, own: Any = None) -> None:
        self.where, self._client, self._own = where, client, own
        self._calls = client.get_executor(pure=False)  # a second call is made again, whatever the first one gave

    def submit(self, function: Callable[..., Any], /, *args: Any, **options: Any) -> Future[Any]:
        answer: Future[Any] = Future()
        self._calls.submit(function, *args, **options).add_done_callback(lambda call: self._pass(call, answer))
        return answer

    def _pass(self, call: Future[Any], answer: Future[Any]) -> None:
        """Give the outcome of Dask's call to ours; errors of the cluster in words that say what to do."""
        try:
            answer.set_result(call.result())
        except CancelledError:
            lost = f"{FLAG} {self.where}: the scheduler is gone; start it, then the same command again: it continues"
            answer.set_exception(UserError(lost))
        except ImportError as error:
            version = "install the same version of bayessim_mjx for its workers"
            answer.set_exception(UserError(f"{FLAG} {self.where}: {error}; {version}"))
        except Exception as error:
            died = type(error).__name__ == "KilledWorker"
            answer.set_exception(UserError(f"{FLAG} {self.where}: {error}") if died else error)

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """Leave the cluster, and end it if it is ours: when all calls are done, or without `wait` at once."""
        with contextlib.suppress(Exception):  # of a scheduler that is gone nothing can be ended
            self._calls.shutdown(wait=wait and not cancel_futures)
            self._client.close()
        if self._own is not None:
            self._own.close()


def connected(where: str, workers: int | None, most: int) -> Dask:
    """Make the executor of a cluster, see `executor`.

    Raises:
        UserError: the extra is missing, nobody answers, or settings are wrong.
    """
    try:
        import distributed
    except ImportError:
        raise UserError(f'{FLAG} {where} needs Dask: pip install "bayessim-mjx[cluster]"') from None
    if where == "local":
        count = workers or min(device.cores(), most)
        own = distributed.LocalCluster(n_workers=count, threads_per_worker=1, dashboard_address=None)
        own.adapt(minimum=count, maximum=count)  # Dask's nanny gives a worker up that dies while it starts
        return Dask(where, distributed.Client(own), own)
    if where.startswith("slurm:"):
        own = _slurm(where, workers or most)
        return Dask(where, distributed.Client(own), own)
    if workers is not None:
        raise UserError(f"{FLAG} {where} and --workers {workers}: its workers are already there; leave --workers out")
    try:
        return Dask(where, distributed.Client(where, timeout=PATIENCE))
    except (OSError, ValueError) as error:
        said = str(error).splitlines()[0]
        raise UserError(f"{FLAG} {where}: no Dask scheduler answers ({said}); start one: dask scheduler") from None


def _slurm(where: str, workers: int) -> Any:
    """Make a cluster of Slurm jobs: at most so many workers, as there is work; an ended job is replaced."""
    path = Path(where.partition(":")[2])
    allowed = "allowed: arguments of dask_jobqueue.SLURMCluster; see docs/cluster.md"
    try:
        from dask_jobqueue import SLURMCluster
    except ImportError:
        raise UserError(f'{FLAG} {where} needs dask-jobqueue: pip install "bayessim-mjx[cluster]"') from None
    try:
        settings = yaml.safe_load(path.read_text(encoding="utf-8"))
        if not isinstance(settings, dict):
            raise TypeError("no mapping of names to values")
        jobs = SLURMCluster(**({"cores": 1, "processes": 1} | settings))
        jobs.job_script()  # what is wrong with a job's settings is said now, not by the first job
    except (TypeError, ValueError, yaml.YAMLError) as error:
        raise UserError(f"{FLAG} {where}: {' '.join(str(error).split())}; {allowed}") from None
    jobs.adapt(minimum=1, maximum=workers)
    return jobs
