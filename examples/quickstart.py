"""Infer the mass and length of a pendulum from one second of its motion: prior -> simulate -> fit -> posterior."""

import argparse

from bayessim_mjx import loop, registry
from bayessim_mjx.config import load
from bayessim_mjx.quantities import estimate

argparse.ArgumentParser(description=__doc__).parse_args()  # --help says what this is
small = ["ppo.max_iterations=5", "bayessim.trainTrajs=2000", "bayessim.realIters=1", "bayessim.realEvals=16"]
config = load("Pendulum", overrides=small)
env = registry.make(config.task, config=config)
parts = loop.make(config, env)
state, rounds = loop.run(parts, loop.init(parts))
assert state.domain is not None and rounds[-1].truth is not None
for (name, row), truth in zip(state.domain.describe().items(), rounds[-1].truth, strict=True):
    print(f"{name}: posterior {estimate(row['mean'], row['sd'])}, hidden truth {truth:.3g}")
