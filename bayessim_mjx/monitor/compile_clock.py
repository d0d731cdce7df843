"""Seconds spent compiling, as JAX itself reports them: tracing, lowering, and XLA or the persistent cache."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

COMPILE = "/jax/core/compile/"
BACKEND = COMPILE + "backend_compile_duration"
RETRIEVED = "/jax/compilation_cache/cache_retrieval_time_sec"
MOST = 0.5  # of the compiler's time, so that a start counts as one from the cache


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
        while self.spans and self.spans[-1][0] >= begun:  # what this one contains: a program traced inside another
            self.spans.pop()
        self.spans.append((begun, end))

    def take(self) -> tuple[float, bool]:
        """(seconds, whether most programs came from the cache) since the last call."""
        seconds = sum(end - begun for begun, end in self.spans)
        cached = self.retrieved > MOST * self.backend
        self.spans, self.backend, self.retrieved = [], 0.0, 0.0
        return seconds, cached
