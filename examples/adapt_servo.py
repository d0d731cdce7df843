"""Adapt the servo pendulum to real logs: 16 runs of a Dynamixel XL330 (Rhoban's BAM), against published values.

    python examples/adapt_servo.py [--out DIR] [--seed N] [section.key=value ...]

The same as `bayessim-mjx main --task ServoPendulum real.logs=DIR` with a small budget, and with the gap (how
far replayed motion is from the logs) before and after. The published fits are BAM's files params/xl330_HEAD_m*.json.
"""

import argparse
import tempfile
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
from convert_xl330 import RAW, convert

from bayessim_mjx import loop, registry
from bayessim_mjx.config import load
from bayessim_mjx.distributions import Distribution
from bayessim_mjx.env import Task
from bayessim_mjx.logs import Log, read_logs, segments
from bayessim_mjx.monitor.console import Console
from bayessim_mjx.quantities import number, spread
from bayessim_mjx.rollout import replay

# load mass, damping = kt^2/R + viscous, Coulomb friction, armature, gain = kt/R
PUBLISHED = {
    "data sheet (nominal)": (0.49, 0.0419, 0.05, 0.002, 0.1041),
    "BAM M1 (Coulomb, viscous)": (0.49, 0.0409, 0.0128, 0.00181, 0.0963),
    "BAM M5 less load friction": (0.49, 0.362**2 / 2.75 + 0.0063, 0.009, 0.00185, 0.362 / 2.75),
}
SMALL = ["ppo.max_iterations=10", "bayessim.realEvals=20", "monitor.video=False"]
WINDOWS = (0.1, 0.25, 0.5)  # s


def gap(env: Task, logs: list[Log], theta: Any, seconds: float) -> float:
    """Root mean square of simulated minus logged angle [rad] over all windows of that length, replayed at theta [d]."""
    data = segments(logs, round(seconds / env.dt), dt=env.dt)
    start, speed, command = (jnp.asarray(data[k]) for k in ("qpos0", "qvel0", "command"))
    motion = replay(env.physics, start, speed, command, jnp.tile(jnp.asarray(theta), (len(start), 1)))
    return float(np.sqrt(np.mean((np.asarray(motion["qpos"]) - data["qpos"]) ** 2)))


def adapt(folder: Path, overrides: list[str], seed: int = 0) -> tuple[Task, Distribution]:
    """Run the outer loop on the logs in `folder`; (task, posterior of the last round)."""
    logs = f"real.logs={folder}"
    config = load("ServoPendulum", flags={"--seed": ("seed", seed)}, overrides=[*SMALL, logs, *overrides])
    env = registry.make(config.task, config=config)
    parts = loop.make(config, env)
    _, rounds = loop.run(parts, loop.init(parts))
    posterior = rounds[-1].posterior
    assert isinstance(env, Task) and posterior is not None
    return env, posterior


def show(env: Task, logs: list[Log], posterior: Distribution) -> None:
    """Two tables: parameters (posterior against published values) and gaps."""
    numbers = posterior.estimates()
    with Console() as console:
        found = [spread(*row) for row in zip(numbers.median, numbers.low, numbers.high, numbers.sd, strict=True)]
        published = [[number(row[k]) for row in PUBLISHED.values()] for k in range(len(found))]
        rows = [[name, *known, own] for name, known, own in zip(env.space.names, published, found, strict=True)]
        console.grid(["parameter", *PUBLISHED, "posterior"], rows)
        gaps = [
            [label, *(number(1e3 * gap(env, logs, values, s)) for s in WINDOWS)]
            for label, values in {**PUBLISHED, "posterior mean": numbers.mean}.items()
        ]
        console.grid(["gap, RMS in mrad", *(f"after {s:g} s" for s in WINDOWS)], gaps)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--out", type=Path, help="where the CSV files and posterior.png go (default: a temporary folder)"
    )
    parser.add_argument("--seed", type=int, default=0)
    args, overrides = parser.parse_known_args()
    if not RAW.is_dir():
        raise SystemExit(f"skipped: the logs are not there ({RAW})")
    out = args.out or Path(tempfile.mkdtemp(prefix="xl330_"))
    print(f"{len(convert(out / 'logs'))} logs in {out / 'logs'}")
    env, posterior = adapt(out / "logs", overrides, args.seed)
    show(env, read_logs(out / "logs", env.mj_model), posterior)
    from bayessim_mjx.monitor import plots

    truth = dict(zip(env.space.names, PUBLISHED["BAM M1 (Coulomb, viscous)"], strict=True))
    figure = plots.corner(posterior, truth=truth, truth_label="published: BAM M1", title="XL330 servo")
    figure.savefig(out / "posterior.png")
    print(f"\npicture: {out / 'posterior.png'}")


if __name__ == "__main__":
    main()
