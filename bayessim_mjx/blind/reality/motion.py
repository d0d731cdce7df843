"""Reference motions of an experimenter, and the eight runs in five operating conditions that are made of them."""

from collections.abc import Callable

import numpy as np

# a choice of what experimenters do; the cases of benchmarks/diagnosis have the same
SECONDS = 4.0
RISE = 0.25  # s, of a step, so that a step asks for an effort that drives have
# (operating condition, profile, amplitude and pace as multiples of the system's)
RUNS = (
    ("slow_triangle", "triangle", 1.0, 0.35),
    ("slow_triangle", "triangle", 0.35, 0.6),
    ("multisine", "multisine", 1.0, 1.0),
    ("multisine", "multisine", 0.4, 1.8),
    ("chirp", "chirp", 0.7, 1.0),
    ("steps", "steps", 0.6, 1.0),
    ("steps", "steps", 1.0, 1.6),
    ("open_loop", "multisine", 1.0, 1.0),
)
Reference = Callable[[float], np.ndarray]


def reference(profile: str, amplitude: np.ndarray, pace: float, rng: np.random.Generator) -> Reference:
    """Motion around zero, `[n]` at any time: joints at different paces and phases, so that they can be told apart."""
    n = len(amplitude)
    paces = pace * rng.uniform(0.75, 1.25, n)
    phases = rng.uniform(0, 1, n)
    if profile == "triangle":

        def at(t: float) -> np.ndarray:
            s = (paces * t + phases) % 1.0
            wave = 4 * np.abs(s - 0.5) - 1
            return amplitude * np.clip(1.25 * wave, -1, 1)  # rests at both ends
    elif profile == "multisine":
        harmonics = np.outer([0.5, 1.0, 1.7, 2.9], paces)
        shares = np.array([0.45, 0.4, 0.25, 0.12])[:, None]
        shift = rng.uniform(0, 2 * np.pi, harmonics.shape)

        def at(t: float) -> np.ndarray:
            return amplitude * (shares * np.sin(2 * np.pi * harmonics * t + shift)).sum(0)
    elif profile == "chirp":

        def at(t: float) -> np.ndarray:
            rate = 0.3 * t + (3.0 - 0.3) * t * t / (2 * SECONDS)  # 0.3 to 3 times the pace
            return amplitude / (1 + 0.35 * t) * np.sin(2 * np.pi * (paces * rate + phases))
    else:
        levels = rng.uniform(-1, 1, (64, n))

        def at(t: float) -> np.ndarray:
            count = np.maximum(t * paces * 1.5 + phases, 0.0)
            whole = count.astype(int)
            s = np.clip((count - whole) / (1.5 * paces * RISE), 0, 1)
            old, new = levels[whole, np.arange(n)], levels[whole + 1, np.arange(n)]
            return amplitude * (old + (new - old) * s * s * (3 - 2 * s))

    return at
