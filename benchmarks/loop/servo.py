"""The loop's posterior of a real servo: what other seeds, other conditions and motion that was kept apart say of it.

    python benchmarks/loop/servo.py --out DIR                  # two seeds on all logs, then each condition left out
    python benchmarks/loop/servo.py --out DIR --only all:0     # one run; DIR/*.json are taken up
    python benchmarks/loop/servo.py --out DIR --summary        # the tables of what is there

16 logs of a Dynamixel XL330 with a pendulum (`examples/adapt_servo.py`), four each at the gains 100, 200, 400 and 800.
Judged are the 90 % intervals of friction and gain: do those of two seeds overlap, and do they hold what the logs
without one gain give, by least squares of free replays and as means of their own posteriors? Then motion: the posterior
and the noise of the logs without one gain predict windows of that gain from their measured starts. Intervals are those
of replays at draws of the posterior, with the forces and the sensors' noise that refinement found, or the sensors'
alone with `bayessim.refine=off`; counted is how often 90 % of them hold what was measured.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from scipy.optimize import least_squares

from bayessim_mjx import loop, registry
from bayessim_mjx.config import load
from bayessim_mjx.kalman import push
from bayessim_mjx.logs import read_logs, segments
from bayessim_mjx.loop.noise import Noise
from bayessim_mjx.rollout import replay
from bayessim_mjx.tracking import Record, close, transitions

ROOT = Path(__file__).resolve().parents[2]
SETTINGS = ["ppo.max_iterations=2", "bayessim.realEvals=4", "monitor.video=False", "bayessim.realIters=1"]
CONDITIONS = ("kp100", "kp200", "kp400", "kp800")
DRAWS, EACH = 64, 16  # of the posterior, and of noise for each
TIMES = (0.1, 0.25, 0.4)  # s after a window's start
LEVEL = 0.9
JUDGED = ("friction", "gain")


def linked(logs: Path, out: Path, condition: str, own: bool) -> Path:
    """A folder with links to the logs of a condition (own), or of all others."""
    out.mkdir()
    for path in logs.iterdir():
        if path.name.startswith(f"{condition}_") == own:
            (out / path.name).symlink_to(path)
    return out


def posterior(folder: Path, seed: int, count: int, overrides: list[str]) -> dict[str, Any]:
    """One round of the loop on `count` windows of the logs in `folder`: draws, intervals, noise."""
    clock, cpu = time.perf_counter(), time.process_time()
    given = [*SETTINGS, f"bayessim.realTrajs={count}", f"real.logs={folder}", *overrides]
    config = load("ServoPendulum", flags={"--seed": ("seed", seed)}, overrides=given)
    env = registry.make(config.task, config=config)
    parts = loop.make(config, env)
    _, rounds = loop.run(parts, loop.init(parts))
    info = rounds[-1]
    assert info.posterior is not None
    draws = np.asarray(info.posterior.sample(jax.random.key(seed), 4096), float)
    refined, nv = info.refinement, env.mj_model.nv
    if refined is not None:  # estimated also where its draws were too few
        noise = refined.noise
    else:  # what simulated trajectories are measured with
        noise = Noise(np.append(parts.source.noise["qpos"], np.full(nv, np.inf)), np.zeros(nv))
    return {
        "names": list(info.posterior.names), "draws": draws[:DRAWS].tolist(),
        "mean": draws.mean(0).tolist(), "sd": draws.std(0).tolist(),
        "interval": np.quantile(draws, [0.5 - LEVEL / 2, 0.5 + LEVEL / 2], axis=0).T.tolist(),
        "refined": refined.sentence() if refined is not None else "not asked for",
        "noise": {"sensor": noise.sensor.tolist(), "process": noise.process.tolist(), "lasting": noise.lasting},
        "seconds": time.perf_counter() - clock, "cpu": time.process_time() - cpu,
    }  # fmt: skip


def windows(env: Any, folder: Path) -> dict[str, np.ndarray]:
    return segments(read_logs(folder, env.mj_model), env_steps(env), dt=env.dt)


def env_steps(env: Any) -> int:
    return round(TIMES[-1] / env.dt)


def refit(env: Any, folder: Path) -> list[float]:
    """Least squares of replays from measured starts, all parameters but the weighed mass, which comes first."""
    data, space = windows(env, folder), env.space
    start, speed, command = (jnp.asarray(data[k]) for k in ("qpos0", "qvel0", "command"))
    weighed = float(space.nominal[0])

    def gaps(logs: np.ndarray) -> np.ndarray:
        theta = jnp.asarray(np.concatenate([[weighed], np.exp(logs)]), jnp.float32)
        motion = replay(env.physics, start, speed, command, jnp.tile(theta, (len(start), 1)))
        return (np.asarray(motion["qpos"], float) - data["qpos"]).ravel()

    low, high = np.log(space.low[1:]), np.log(space.high[1:])
    found = least_squares(gaps, np.log(space.nominal[1:]), bounds=(low, high), diff_step=1e-2, x_scale=0.1)
    return [weighed, *np.exp(found.x).tolist()]


def covered(env: Any, data: dict[str, np.ndarray], found: dict[str, Any], seed: int = 0) -> dict[str, float]:
    """How often 90 % intervals of predicted positions hold the measured ones, by seconds after a window's start."""
    rng, nv, steps = np.random.default_rng(seed), env.mj_model.nv, env_steps(env)
    noise = Noise(*(np.asarray(found["noise"][k]) for k in ("sensor", "process")), found["noise"]["lasting"])
    thetas = np.asarray(found["draws"])
    start, speed, command = (jnp.asarray(data[k], jnp.float32) for k in ("qpos0", "qvel0", "command"))
    record = Record(*(jnp.asarray(data[k], jnp.float32) for k in ("qpos", "qvel", "command")))
    travel = np.maximum(np.concatenate([np.ptp(data["qpos"], (0, 1)), np.ptp(data["qvel"], (0, 1))]), 1e-6)
    ways, _ = transitions(env.physics, thetas.mean(0), record, close(record, nv), travel)
    sd = np.where(np.isfinite(noise.sensor), noise.sensor, 0.0)
    speed_sd = sd[nv:] if sd[nv:].any() else sd[:nv] / env.dt  # a velocity from positions
    count = len(start)
    inside = np.zeros((count, steps))

    def motion(theta: np.ndarray) -> np.ndarray:
        every = jnp.tile(jnp.asarray(theta, jnp.float32), (count, 1))
        return np.asarray(replay(env.physics, start, speed, command, every)["qpos"], float)[..., 0]

    shown = np.stack([motion(theta) for theta in thetas])
    size = (DRAWS * EACH, count, nv)
    away = np.concatenate([sd[:nv] * rng.normal(size=size), speed_sd * rng.normal(size=size)], axis=-1)
    force = noise.process * rng.normal(size=size)
    fresh = noise.process * np.sqrt(1 - noise.lasting**2)
    for t in range(steps):
        pushed = force @ push(nv, env.dt).T
        away = np.einsum("nij,mnj->mni", np.nan_to_num(ways[:, t]), away) + pushed
        force = noise.lasting * force + fresh * rng.normal(size=size)
        seen = np.repeat(shown[:, :, t + 1], EACH, axis=0) + away[..., 0] + sd[0] * rng.normal(size=size[:2])
        low, high = np.quantile(seen, [0.5 - LEVEL / 2, 0.5 + LEVEL / 2], axis=0)
        measured = data["qpos"][:, t + 1, 0]
        inside[:, t] = (measured >= low) & (measured <= high)
    at = {f"{seconds:g} s": float(inside[:, round(seconds / env.dt) - 1].mean()) for seconds in TIMES}
    return at | {"all": float(inside.mean()), "windows": count}


def one(name: str, logs: Path, count: int, overrides: list[str]) -> dict[str, Any]:
    """`all:SEED`: the posterior of all logs; `without:kp100`: that of the others, its refit, what it predicts."""
    kind, _, which = name.partition(":")
    if kind == "all":
        return posterior(logs, int(which), count, overrides)
    with tempfile.TemporaryDirectory() as place:
        others = linked(logs, Path(place) / "others", which, own=False)
        apart = linked(logs, Path(place) / "apart", which, own=True)
        found = posterior(others, 0, count, overrides)
        env = registry.make("ServoPendulum")
        found["refit"] = refit(env, others)
        found["covered"] = covered(env, windows(env, apart), found)
        found["covered in sample"] = covered(env, windows(env, others), found)
    return found


def summary(out: Path) -> None:
    """The tables of the runs in `out`."""
    runs = {path.stem.replace("-", ":"): json.loads(path.read_text()) for path in sorted(out.glob("*.json"))}
    for name, run in runs.items():
        cells = [
            f"{n} {m:.4g} ({a:.4g} to {b:.4g})"
            for n, m, (a, b) in zip(run["names"], run["mean"], run["interval"], strict=True)
        ]
        print(f"{name}: {', '.join(cells)}; {run['refined']}; {run['cpu']:.0f} CPU s")
    seeds, left = ({k: r for k, r in runs.items() if k.startswith(f"{kind}:")} for kind in ("all", "without"))
    for name in JUDGED:
        spans = []
        for key, run in seeds.items():
            place = next(i for i, n in enumerate(run["names"]) if n.endswith(name))
            low, high = run["interval"][place]
            spans.append((low, high))
            for kind, each in (("refits", "refit"), ("means of the posteriors", "mean")):
                found = [r[each][place] for r in left.values()]
                held = sum(low <= x <= high for x in found)
                print(f"{name}, {key}: holds {held} of {len(found)} {kind}: {[round(x, 4) for x in found]}")
        if len(spans) > 1:
            print(f"{name}: intervals of seeds overlap: {max(a for a, _ in spans) <= min(b for _, b in spans)}")
    for key, run in left.items():
        print(f"{key}: 90 % intervals hold {run['covered']}; in sample {run['covered in sample']}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--only", nargs="*", default=["all:0", "all:1", *(f"without:{c}" for c in CONDITIONS)])
    parser.add_argument("--windows", type=int, default=32, help="of .4 s, that a posterior is of")
    parser.add_argument("--summary", action="store_true")
    args, overrides = parser.parse_known_args()
    overrides += [text for text in args.only if "=" in text]  # settings behind the names of runs
    args.only = [text for text in args.only if "=" not in text]
    if not args.summary:
        sys.path.insert(0, str(ROOT / "examples"))
        from convert_xl330 import RAW, convert

        if not RAW.is_dir():
            raise SystemExit(f"skipped: the logs are not there ({RAW})")
        logs = args.out / "logs"
        convert(logs)
        for name in args.only:
            path = args.out / f"{name.replace(':', '-')}.json"
            if not path.exists():
                path.write_text(json.dumps(one(name, logs.resolve(), args.windows, overrides), indent=1))
    summary(args.out)


if __name__ == "__main__":
    main()
