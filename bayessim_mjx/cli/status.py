"""A run's status, Ctrl-C at whole states, and which of several processes writes."""

import contextlib
import dataclasses
import os
import signal
import sys
import threading
import types
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from bayessim_mjx import trust
from bayessim_mjx.cli.ends import one_line
from bayessim_mjx.config import Config
from bayessim_mjx.errors import UserError, disk_is_full

if TYPE_CHECKING:
    from bayessim_mjx.runs import Run


class Stop:
    """Ctrl-C (or SIGTERM) asked for: `requested` is looked at where the state is whole, `when` says when that is."""

    requested = False
    when = "after this step"

    def check(self) -> None:
        """End here if a stop was asked for."""
        if self.requested:
            raise KeyboardInterrupt

    def save(self, save: Callable[[], Any]) -> None:
        """If a stop was asked for: save a checkpoint, then end."""
        if self.requested:
            save()
            raise KeyboardInterrupt


@contextlib.contextmanager
def graceful() -> Iterator[Stop]:
    """While inside, the first Ctrl-C asks for a stop at the next whole state, and the second one stops at once."""
    stop, before = Stop(), {}

    def ask(number: int, frame: types.FrameType | None) -> None:
        if stop.requested:
            raise KeyboardInterrupt
        stop.requested = True
        print(f"\nstopping {stop.when}, with a checkpoint (again: at once)", file=sys.stderr)

    if threading.current_thread() is threading.main_thread():
        before = {n: signal.signal(n, ask) for n in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield stop
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@contextlib.contextmanager
def first_writes(config: Config, run: "Run | None") -> Iterator[tuple[Config, "Run | None"]]:
    """Of several processes the first one alone writes: the others work silently in folders that are then removed."""
    import jax

    if jax.process_count() == 1:
        yield config, run
        return
    import shutil
    import tempfile

    from jax.experimental.multihost_utils import sync_global_devices

    from bayessim_mjx.runs import Run

    with contextlib.ExitStack() as stack:
        if jax.process_index() > 0:
            folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="bayessim_mjx_")))
            config = dataclasses.replace(config, logdir=str(folder))
            run = run and Run.open(shutil.copytree(run.path, folder / "run"))
            stack.enter_context(contextlib.redirect_stdout(stack.enter_context(open(os.devnull, "w"))))
        sync_global_devices("the run to go on with is read")
        yield config, run
        sync_global_devices("the run is finished")


@contextlib.contextmanager
def running(run: "Run", say: Callable[[str], Any]) -> Iterator[None]:
    """Write the run's status: running while inside; then finished, interrupted (Ctrl-C) or failed (`error`)."""
    try:
        run.set_status("running")
        yield
        run.set_status("finished")
    except KeyboardInterrupt:
        run.set_status("interrupted")
        say(f"interrupted; go on with --resume {run.path}{trust.flags()}")
        raise
    except Exception as error:
        full = disk_is_full(error)
        with contextlib.suppress(OSError):  # what cannot be written must not hide the first error
            run.set_status("failed", "the disk is full" if full else f"{type(error).__name__}: {error}")
        if full:
            why = one_line(error)
            advice = f"make room and go on with --resume {run.path}{trust.flags()}"
            raise UserError(f"{run.path}: the disk is full ({why}); {advice}") from error
        raise
