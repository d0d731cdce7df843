"""Time to go, and seconds spent compiling as JAX itself reports them: tracing, lowering, and XLA or the cache."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any, Protocol

COMPILE = "/jax/core/compile/"
BACKEND = COMPILE + "backend_compile_duration"
RETRIEVED = "/jax/compilation_cache/cache_retrieval_time_sec"
REPORTED = 2.0  # seconds of compilation that get a line
CACHED = 0.5  # of the compiler's time, so that a start counts as one from the cache
STEPS = 100_000  # timesteps of a reference
BODY = """
<mujoco><option timestep="0.002"/><worldbody><geom type="plane" size="5 5 .1"/><body pos="0 0 1"><freejoint/>
<geom type="capsule" fromto="0 0 0 0 .3 0" size=".05"/><body pos="0 .3 0"><joint axis="1 0 0" damping=".1"/>
<geom type="capsule" fromto="0 0 0 0 .3 0" size=".04"/><body pos="0 .3 0"><joint axis="1 0 0" damping=".1"/>
<geom type="capsule" fromto="0 0 0 0 .3 0" size=".03"/></body></body></body></worldbody></mujoco>
"""


def reference(steps: int = STEPS) -> tuple[float, float]:
    """Wall and CPU seconds that MuJoCo, in C, takes on one core for STEPS timesteps of BODY; by `steps` of them."""
    import mujoco

    model = mujoco.MjModel.from_xml_string(BODY)
    data = mujoco.MjData(model)
    wall, cpu = time.perf_counter(), time.process_time()
    mujoco.mj_step(model, data, steps)
    return (time.perf_counter() - wall) * STEPS / steps, (time.process_time() - cpu) * STEPS / steps


class Clock:
    """Time to go, from the mean duration of the steps done here; compiling is not counted as a step's time."""

    def __init__(self, total: int, done: int = 0, now: Callable[[], float] = time.monotonic):
        self.total, self.done, self.now = total, done, now
        self.first, self.begun, self.excluded = done, now(), 0.0

    def exclude(self, seconds: float) -> None:
        self.excluded += seconds

    def advance(self, to: int | None = None) -> None:
        self.done = self.done + 1 if to is None else to

    def eta(self) -> float | None:
        """Seconds to go; None before the first step is done."""
        steps = self.done - self.first
        if steps <= 0:
            return None
        return max(self.now() - self.begun - self.excluded, 0.0) / steps * max(self.total - self.done, 0)


class _Console(Protocol):
    def compile(self, message: str, seconds: float, cached: bool = False) -> None: ...


class CompileClock:
    """Counts from its construction on; `take` gives what has come since the last call."""

    def __init__(self, now: Callable[[], float] = time.monotonic) -> None:
        import jax.monitoring

        self.now, self.backend, self.retrieved = now, 0.0, 0.0
        self.spans: list[tuple[float, float]] = []
        jax.monitoring.register_event_duration_secs_listener(self._duration)

    def _duration(self, event: str, duration_secs: float, **_: Any) -> None:
        if event == RETRIEVED:
            self.retrieved += duration_secs
        if not event.startswith(COMPILE):
            return
        self.backend += duration_secs if event == BACKEND else 0.0
        begun, end = self.now() - duration_secs, self.now()
        while self.spans and self.spans[-1][1] > begun:  # a program traced inside another, or compiled beside it
            begun = min(begun, self.spans.pop()[0])
        self.spans.append((begun, end))

    def take(self) -> tuple[float, bool]:
        """(seconds, whether most programs came from the cache) since the last call."""
        seconds = sum(end - begun for begun, end in self.spans)
        cached = self.retrieved > CACHED * self.backend
        self.spans, self.backend, self.retrieved = [], 0.0, 0.0
        return seconds, cached

    def report(self, console: _Console, what: str) -> bool:
        """Print what was compiled since the last call, if it took long enough; whether it did."""
        seconds, cached = self.take()
        if long := seconds > REPORTED:
            console.compile(what, seconds, cached)
        return long
