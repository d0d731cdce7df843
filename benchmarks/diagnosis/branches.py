"""CPU time of a simulated sub-step with all effects on offer, with and without branches around those that are off.

    python benchmarks/diagnosis/branches.py CASE [CASE ...]     # folders with model.xml and logs/

Prints seconds of compilation, microseconds of the processor for each sub-step of one world (neutral, and with one
effect on in each parameter vector), and the largest difference of the two motions.
"""

import argparse
import time
from pathlib import Path

import numpy as np

from bayessim_mjx.diagnosis.fitting.robot import robot_of
from bayessim_mjx.diagnosis.fitting.simulator import Simulator
from bayessim_mjx.diagnosis.setup import Setup, prepare
from bayessim_mjx.logs import read_logs

THETAS = 12


def one_each(setup: Setup) -> np.ndarray:
    """Parameter vectors `[THETAS, d]`, each with one effect on, spread over the candidates."""
    fitter, every = setup.fitter, setup.candidates
    chosen = [every[i] for i in np.linspace(0, len(every) - 1, THETAS).astype(int)]
    known = [c.neutral for c in fitter.base]
    return np.stack([fitter.vector((*fitter.base, *c.coordinates), np.array([*known, *c.probes[0]])) for c in chosen])


def timed(simulator: Simulator, thetas: np.ndarray) -> tuple[float, np.ndarray]:
    """(microseconds of the processor for a sub-step of a world, errors)."""
    began = time.process_time()
    errors = simulator.run(thetas)
    took = time.process_time() - began
    count = len(thetas) * len(simulator.windows) * simulator.windows.steps * simulator.physics.substeps
    return 1e6 * took / count, errors


def compare(case: Path) -> None:
    robot = robot_of(case / "model.xml", None)
    setup = prepare(robot, read_logs(case / "logs", robot.mj_model, None, partial=True))
    fitter, thetas = setup.fitter, one_each(setup)
    same = np.repeat(fitter.theta[None], THETAS, 0)
    motions, effects = [], len(setup.physics.effects)
    print(f"{case}: {setup.physics.mj_model.nv} joints, {effects} effects, {len(setup.candidates)} candidates")
    for branches in (True, False):
        simulator = Simulator(setup.physics, fitter.simulator.windows)
        simulator.apart = branches
        began = time.process_time()
        simulator.run(same[:1])
        compiling = time.process_time() - began
        (still, a), (moved, b) = timed(simulator, same), timed(simulator, thetas)
        motions.append((a, b))
        label = "branches" if branches else "all computed"
        print(f"  {label:12s} compile {compiling:5.1f} s, neutral {still:6.2f} us, one effect each {moved:6.2f} us")
    apart = max(float(np.abs(x - y).max()) for x, y in zip(*motions, strict=True))
    print(f"  largest difference of the motions {apart:g} rad or rad/s")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("cases", type=Path, nargs="+")
    for case in parser.parse_args().cases:
        compare(case)


if __name__ == "__main__":
    main()
