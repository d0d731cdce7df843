"""Many calls at a time, as a `concurrent.futures.Executor`: processes of this machine, or Dask's on a cluster."""

from pathlib import Path

from bayessim_mjx import device
from bayessim_mjx.pool.clusters import CLUSTER, connected
from bayessim_mjx.pool.commands import alone
from bayessim_mjx.pool.processes import Processes, Stopping

__all__ = ["CLUSTER", "Stopping", "alone", "executor"]


def executor(
    where: str = "", workers: int | None = None, most: int = 1024, folder: Path | None = None, share: bool = True
) -> Stopping:
    """Make the executor that runs many calls; use it as a block.

    A process that dies is replaced, and its call runs again. Left by an error, the block ends what still runs.

    Args:
        where: "": processes of this machine; else a cluster, see `clusters.cluster`.
        workers: calls at a time; None: as many as cores, or as the cluster gives.
        most: calls that can be under way at a time. folder: where processes of this machine write what they print.
        share: whether they share its cores out; a call by `alone` takes one itself.

    Raises:
        UserError: the cluster does not answer, its settings are wrong, or the extra is not installed.
    """
    if not where:
        return Processes(workers or min(device.cores(), most), folder, share)
    return connected(where, workers, most)
