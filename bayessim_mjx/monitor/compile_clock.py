"""Seconds spent compiling, as JAX itself reports them: tracing, lowering, and XLA or the persistent cache."""

from __future__ import annotations

from typing import Any

COMPILE = "/jax/core/compile/"
CACHE_HIT = "/jax/compilation_cache/cache_hits"
CACHE_MISS = "/jax/compilation_cache/cache_misses"


class CompileClock:
    """Counts from its construction on; `take` gives what has come since the last call."""

    def __init__(self) -> None:
        import jax.monitoring

        self.seconds, self.hits, self.misses = 0.0, 0, 0
        jax.monitoring.register_event_duration_secs_listener(self._duration)
        jax.monitoring.register_event_listener(self._event)

    def _duration(self, event: str, seconds: float, **_: Any) -> None:
        if event.startswith(COMPILE):
            self.seconds += seconds

    def _event(self, event: str, **_: Any) -> None:
        self.hits += event == CACHE_HIT
        self.misses += event == CACHE_MISS

    def take(self) -> tuple[float, bool]:
        """(seconds, whether most programs came from the cache) since the last call."""
        taken = self.seconds, self.hits > self.misses
        self.seconds, self.hits, self.misses = 0.0, 0, 0
        return taken
