"""Infer the mass and length of a pendulum from one second of its motion: prior -> simulate -> fit -> posterior."""

import argparse

from bayessim_mjx import loop, registry
from bayessim_mjx.config import load

argparse.ArgumentParser(description=__doc__).parse_args()  # --help says what this is
small = ["ppo.max_iterations=5", "bayessim.trainTrajs=2000", "bayessim.realIters=1", "bayessim.realEvals=16"]
config = load("Pendulum", overrides=small)
env = registry.make(config.task, config=config)
parts = loop.make(config, env)
state, rounds = loop.run(parts, loop.init(parts))
assert state.domain is not None
for name, row in state.domain.describe().items():
    print(name, row)
print("hidden truth:", rounds[-1].truth)
