"""Many calls at a time, as a `concurrent.futures.Executor`: processes of this machine, or Dask's on a cluster."""

from pathlib import Path

from bayessim_mjx import device
from bayessim_mjx.pool.clusters import FLAG, HELP, cluster, connected
from bayessim_mjx.pool.processes import Processes, Stopping

__all__ = ["FLAG", "HELP", "Stopping", "cluster", "executor"]


def executor(where: str = "", workers: int | None = None, most: int = 1024, folder: Path | None = None) -> Stopping:
    """Make the executor that runs many calls; use it as a block.

    A process that dies is replaced, and its call runs again. Left by an error, the block ends what still runs.

    Args:
        where: "": processes of this machine; else a cluster, see `cluster`.
        workers: calls at a time; None: as many as cores, or as the cluster gives.
        most: calls that can be under way at a time. folder: where processes of this machine write what they print.

    Raises:
        UserError: the cluster does not answer, its settings are wrong, or the extra is not installed.
    """
    if not where:
        return Processes(workers or min(device.cores(), most), folder)
    return connected(where, workers, most)
