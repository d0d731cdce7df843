"""Which effects and strengths the cases of a seed have: effects take turns, so that all come up equally often."""

import zlib
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
from cases import KNOWN, SYSTEMS, UNKNOWN, places

from bayessim_mjx.blind.reality.joints import TwoBodies
from bayessim_mjx.blind.reality.plant import Plant, scales_of

SECOND_BODY = {cause.name for cause in TwoBodies.__subclasses__()}
Job = tuple[str, str, tuple[str, ...], str, int, Path]


def jobs(
    out: Path, seeds: Iterable[int], kinds: Iterable[str], systems: Iterable[str], strengths: list[str]
) -> list[Job]:
    """(kind, system, effects, strength, seed, folder); effects take turns, so that all come up equally often."""
    found = []
    for system in systems:
        robot = SYSTEMS[system]
        plain = Plant(robot, {})
        scales = scales_of(plain, [robot.record(plain, 0, 0, noise=False)])
        known, unknown = ([e for e in names if places(robot, e, scales)] for names in (KNOWN, UNKNOWN))
        shift = zlib.crc32(system.encode())
        known, unknown = (list(np.random.default_rng(shift).permutation(names)) for names in (known, unknown))
        for seed in seeds:
            rng = np.random.default_rng((seed, shift))
            strength = str(rng.choice(strengths))
            drawn = {
                "single": (str(known[seed % len(known)]),),
                "double": _pair(rng, known),
                "null": (),
                "unknown": (str(unknown[seed % len(unknown)]),),
            }
            found += [(k, system, drawn[k], strength, seed, out / f"{system}_{k}_s{seed}") for k in kinds]
    return found


def _pair(rng: np.random.Generator, known: Sequence[str]) -> tuple[str, ...]:
    """Two effects that a plant can have at one joint: there is one second body behind a rotor."""
    while {*(drawn := tuple(str(e) for e in rng.choice(known, 2, replace=False)))} == SECOND_BODY:
        pass
    return drawn
