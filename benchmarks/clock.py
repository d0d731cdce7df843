"""Seconds that a person waits for, by what they are spent on, in seconds and in references.

    python benchmarks/clock.py [ROW ...] [--commit HASH]     # writes records/clock.json: rows in place of its own

Each row is a command in a fresh process: `cold` with an empty cache of its own, `second` once more with what it left
there. A reference is what `monitor.clock.reference` takes in the same run, MuJoCo in C on one core: figures in
references compare machines, and busy hours of one. CPU seconds are those of all threads.

Every moment counts as one thing alone: as tracing (with lowering) or compiling (or loading from the cache) while any
thread does that, else as what the innermost of FUNCTIONS on the main thread is for, else as the rest.
"""

from __future__ import annotations

import argparse
import builtins
import contextlib
import functools
import json
import os
import re
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from importlib import import_module
from pathlib import Path
from typing import Any

from bayessim_mjx.monitor.clock import reference

HERE = Path(__file__).parent
RECORD = HERE / "records" / "clock.json"
PARTS = ("import", "trace", "compile", "simulate", "learn", "infer", "check", "draw", "write", "rest")
STAGES = {  # events of jax, which begin and end on one thread
    "/jax/core/compile/jaxpr_trace_duration": "trace",
    "/jax/core/compile/jaxpr_to_mlir_module_duration": "trace",
    "/jax/core/compile/backend_compile_duration": "compile",
}
LOOP, ROUND = "bayessim_mjx.loop.outer_loop", "bayessim_mjx.loop.round_inference"
CHECKS, FOUND = "bayessim_mjx.loop.examination", "bayessim_mjx.diagnosis.run"
# part: where its functions are looked up by those that call them
FUNCTIONS = {
    "simulate": (f"{LOOP}:_evaluate", f"{ROUND}:simulate", f"{ROUND}:observe", "bayessim_mjx.programs:Kept.__call__"),
    "learn": (f"{LOOP}:train", f"{ROUND}:train", f"{FOUND}:selecting.select"),
    "infer": (f"{ROUND}:condition", "bayessim_mjx.loop.likelihood_refinement:refine"),
    "check": (f"{ROUND}:check", f"{CHECKS}:judge", f"{CHECKS}:recalibrated", f"{FOUND}:carry_out"),
    "draw": ("bayessim_mjx.monitor.session:Session._plots", "bayessim_mjx.report:write"),
    "write": ("bayessim_mjx.runs.folder:Run.save", "bayessim_mjx.monitor.session:Session.flush"),
}
# row: its kind and its command
ROWS = {
    "main Pendulum": ("main", "main --task Pendulum --headless --logdir {scratch}/logs"),
    "diagnose pendulum": (
        "diagnose",
        "diagnose --task Pendulum --data {scratch}/logs --accuracy 5% --out {scratch}/found --headless",
    ),
    "import": ("import", ""),
}


class Account:
    """Wall and CPU seconds by part; each moment is charged to one part, or in equal shares to threads that compile."""

    def __init__(self) -> None:
        self.lock, self.main = threading.RLock(), threading.get_ident()
        self.stacks: dict[int, list[str]] = {self.main: ["rest"]}
        self.wall: Counter[str] = Counter()
        self.cpu: Counter[str] = Counter()
        self.last = time.perf_counter(), time.process_time()

    def charge(self) -> None:
        """Charge what has passed since the last change to what was done then."""
        now = time.perf_counter(), time.process_time()
        inner = [stack[-1] for stack in self.stacks.values() if stack]
        who = [part for part in inner if part in STAGES.values()] or [self.stacks[self.main][-1]]
        for spent, seconds in zip(
            (self.wall, self.cpu), (b - a for a, b in zip(self.last, now, strict=True)), strict=True
        ):
            for part in who:
                spent[part] += seconds / len(who)
        self.last = now

    def enter(self, part: str) -> None:
        with self.lock:
            self.charge()
            self.stacks.setdefault(threading.get_ident(), []).append(part)

    def leave(self) -> None:
        with self.lock:
            self.charge()
            self.stacks[threading.get_ident()].pop()

    @contextlib.contextmanager
    def during(self, part: str) -> Iterator[None]:
        self.enter(part)
        try:
            yield
        finally:
            self.leave()

    def around(self, part: str, function: Callable[..., Any]) -> Callable[..., Any]:
        @functools.wraps(function)
        def call(*args: Any, **named: Any) -> Any:
            with self.during(part):
                return function(*args, **named)

        return call

    def importing(self) -> None:
        """Charge imports of modules that were not there."""
        plain = builtins.__import__

        def load(name: str, *args: Any, **named: Any) -> Any:
            if name in sys.modules or (len(args) > 3 and args[3]) or threading.get_ident() != self.main:
                return plain(name, *args, **named)
            with self.during("import"):
                return plain(name, *args, **named)

        builtins.__import__ = load

    def listening(self) -> None:
        """Charge what jax builds, and wait for its programs where they are called."""
        import jax

        jax.config.update("jax_cpu_enable_async_dispatch", False)

        def begun(event: str, _: float, **__: Any) -> None:
            if event in STAGES:
                self.enter(STAGES[event])

        def done(event: str, _: float, **__: Any) -> None:
            if event in STAGES:
                self.leave()

        jax.monitoring.register_scalar_listener(begun)
        jax.monitoring.register_event_duration_secs_listener(done)

    def wrapping(self, names: dict[str, tuple[str, ...]]) -> None:
        """Charge functions, by where they are looked up."""
        for part, places in names.items():
            for place in places:
                module, _, path = place.partition(":")
                *owners, name = path.split(".")
                owner = functools.reduce(getattr, owners, import_module(module))
                setattr(owner, name, self.around(part, getattr(owner, name)))


def watched(target: Path, begun: float, kind: str, command: list[str]) -> int:
    """Run a command in this process; write its seconds by part."""
    account = Account()
    account.wall["import"] = time.time() - begun  # of the interpreter, and of what it has loaded so far
    account.cpu["import"] = time.process_time()
    account.importing()
    with account.during("import"):
        from bayessim_mjx.main import main

        for module in ("bayessim_mjx.loop", "bayessim_mjx.registry", "bayessim_mjx.diagnosis.run"):
            import_module(module)
    account.listening()
    if command:
        account.wrapping(
            {p: tuple(f for f in fs if (FOUND in f) <= (kind == "diagnose")) for p, fs in FUNCTIONS.items()}
        )
    code = main(command) if command else 0
    account.charge()
    target.write_text(json.dumps({"wall": account.wall, "cpu": account.cpu}), encoding="utf-8")
    return code


def record_logs(folder: Path) -> None:
    """Write the logs of examples/diagnose_pendulum.py: friction and a weak motor."""
    sys.path.insert(0, str(HERE.parent / "examples"))
    from diagnose_pendulum import real_pendulum, record

    from bayessim_mjx import registry
    from bayessim_mjx.config import load

    env = registry.make("Pendulum", config=load("Pendulum", overrides=["task.randomize=False"]))
    record(real_pendulum(env), env.dt, folder)  # type: ignore[arg-type]


def measured(name: str) -> list[list[str]]:
    """Rows of the table: cold and second, wall and CPU."""
    kind, words = ROWS[name]
    found = []
    with tempfile.TemporaryDirectory() as scratch:
        command = [word.format(scratch=scratch) for word in words.split()]
        if kind == "diagnose":
            record_logs(Path(scratch, "logs"))
        for start in ("cold", "second") if command else ("",):
            environment = os.environ | {"BAYESSIM_MJX_CACHE": f"{scratch}/cache"}
            before, target = reference(), Path(scratch, "seconds.json")
            own = [sys.executable, __file__, "--watched", str(target), str(time.time()), kind, *command]
            subprocess.run(own, env=environment, check=True, stdout=subprocess.DEVNULL)
            spent = json.loads(target.read_text(encoding="utf-8"))
            after = reference()
            for at, clock in enumerate(("wall", "cpu")):
                total, unit = sum(spent[clock].values()), (before[at] + after[at]) / 2
                parts = [f"{spent[clock].get(part, 0.0):.1f}" for part in PARTS]
                row = f"{name}, {start}, {clock}" if start else f"{name}, {clock}"
                found.append([row, f"{total:.1f}", f"{unit:.2f}", f"{total / unit:.0f}", *parts])
                print(*found[-1], sep="  ", flush=True)
    return found


def main() -> int:
    if sys.argv[1:2] == ["--watched"]:
        target, begun, kind, *command = sys.argv[2:]
        return watched(Path(target), float(begun), kind, command)
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("rows", nargs="*", metavar="ROW", help=", ".join(ROWS))
    parser.add_argument("--commit", help="that the figures are of; none: nothing is written")
    args = parser.parse_args()
    if wrong := {*args.rows} - {*ROWS}:
        parser.error(f"{', '.join(sorted(wrong))}: rows are {', '.join(ROWS)}")
    rows = [row for name in args.rows or ROWS for row in measured(name)]
    if args.commit:
        record = json.loads(RECORD.read_text(encoding="utf-8"))
        known = {row[0]: row for row in record["table"]} | {row[0]: row for row in rows}
        record |= {"table": list(known.values()), "commit": args.commit}
        text = json.dumps(record, indent=1, ensure_ascii=False) + "\n"
        rows = re.compile(r"\[\n\s+([^\[\]{}]*?)\n\s+\]")
        text = rows.sub(lambda found: "[" + re.sub(r"\n\s+", " ", found[1]) + "]", text)
        RECORD.write_text(text, encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
