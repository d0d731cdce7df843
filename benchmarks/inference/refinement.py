"""Coverage and gain of posteriors refined by replays (`bayessim.refine`), for more and more trajectories.

    python benchmarks/inference/refinement.py --system linear --n 1 4 16 --truths 50 --out refinement.json

The prior proposes, so a network's quality is no part of it. Posteriors are judged as the loop uses them: with
`bayessim.components` Gaussians and a share of the prior. A table tells how often
the 50, 80 and 95 % regions hold the truth, with binomial standard errors, the mean gain over the prior in nats, and how
many posteriors were not refined (they are out of the coverage and in the gain). Systems: `linear` is a cart under two
motors of unknown strength; `damped` a pendulum of unknown mass, damping and motor; `Pendulum` (BayesSimIG's) and
`Cartpole` are the library's tasks. Of the first two the exact posterior is known (`exact_posteriors.py`), and the same
truths are counted in it: what it misses too is chance. Chance in the truths apart, `holds of the exact` are the shares
of the exact posterior in the refined one's regions, and `divergence` the nats that it loses on the mean (Kullback and
Leibler). `--wrong` adds to reality what the simulator lacks. `--sensors` are those of logs: `white` noise whose size
is told; `positions` alone; positions in `counts` of an encoder; `late` velocities, a control step old. The noise
of the last three is estimated, and velocities pass the gate, as with `real.logs` (`--ungated`: they are all believed).
"""

from __future__ import annotations

import argparse
import dataclasses
import itertools
import json
import time
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import mujoco
import numpy as np
from exact_posteriors import Recorded, exact

from bayessim_mjx import make
from bayessim_mjx.distributions import Distribution
from bayessim_mjx.logs import Channels, Log, estimate_velocity, noise
from bayessim_mjx.logs.signals import noise_level
from bayessim_mjx.loop.likelihood import Likelihood
from bayessim_mjx.loop.likelihood_refinement import refine
from bayessim_mjx.parameters import Parameter, ParameterSpace
from bayessim_mjx.physics import Physics
from bayessim_mjx.physics.tangent import in_tangent
from bayessim_mjx.rollout import replay
from bayessim_mjx.tracking import Record

LEVELS = (0.5, 0.8, 0.95)
STEPS, HELD = 60, 5  # control steps of a trajectory; those for which a random command is held
MOST = 32  # trajectories behind a truth, of which the first n are used
PRIOR_SHARE, COMPONENTS = 1e-4, 8  # as the loop has them
WRONG = {"none": "nothing", "gusts": "forces as large as .3 of the commands, .5 s each", "delay": "2 steps of delay"}

SENSORS = ("white", "positions", "counts", "late")

CART = """<mujoco><option timestep=".02" gravity="0 0 0"/><worldbody><body name="cart">
  <joint name="x" type="slide" axis="1 0 0" damping="1" stiffness="4"/><geom size=".1" mass="2"/></body></worldbody>
  <actuator><general name="a" joint="x" gainprm="10" ctrlrange="-1 1"/>
  <general name="b" joint="x" gainprm="5" ctrlrange="-1 1"/></actuator></mujoco>"""
HINGE = """<mujoco><option timestep=".02"/><worldbody><body name="link">
  <joint name="q" type="hinge" axis="0 1 0" damping=".2"/>
  <geom type="capsule" fromto="0 0 0 0 0 -.5" size=".02" mass="1"/>
  </body></worldbody><actuator><general name="a" joint="q" gainprm="3" ctrlrange="-1 1"/></actuator></mujoco>"""


@dataclass(frozen=True)
class System:
    """A simulator, and the sensors' standard deviation relative to a typical motion of each channel."""

    physics: Physics
    sd: float
    ratios: bool | None = None  # of its parameters are all that is identified; None: the exact posterior is not known

    @property
    def space(self) -> ParameterSpace:
        return self.physics.space


def scaled(name: str, attribute: str, kind: str, target: str, low: float, high: float) -> Parameter:
    return Parameter(name, 1.0, low, high, operation="scaling", attribute=attribute, target=target, kind=kind)


def system(name: str) -> System:
    if name == "linear":
        space = ParameterSpace([scaled(f"gain {m}", "gain", "actuator", m, 0.2, 3.0) for m in "ab"])
        return System(Physics(mujoco.MjModel.from_xml_string(CART), 0.04, space), 0.1, ratios=False)
    if name == "damped":
        parts = [("mass", "body", "link", 0.5, 2), ("damping", "joint", "q", 0.2, 3), ("gain", "actuator", "a", 0.5, 2)]
        space = ParameterSpace([scaled(attribute, attribute, *rest) for attribute, *rest in parts])
        return System(Physics(mujoco.MjModel.from_xml_string(HINGE), 0.04, space), 0.05, ratios=True)
    return System(make(name).physics, 0.05)


def gusty(rng: np.random.Generator, command: np.ndarray, strength: float = 0.3) -> np.ndarray:
    gust = np.repeat(rng.normal(size=(len(command), -(-STEPS // 10), command.shape[-1])), 10, axis=1)[:, :STEPS]
    return command + strength * np.std(command) * gust


def recorded(
    at: System, seed: int, wrong: str, sensors: str = "white", n: int = MOST, gated: bool = True
) -> tuple[np.ndarray, Record, np.ndarray]:
    """(theta, the first n of MOST trajectories, sensors' sd [2 nv]) of truth number `seed`."""
    rng, model = np.random.default_rng([17, seed]), at.physics.mj_model
    theta = np.asarray(at.space.from_unit(jnp.asarray(rng.uniform(0, 1, len(at.space)), jnp.float32)))
    start = rng.uniform(-1, 1, (2, MOST, model.nv))
    high = np.where(model.actuator_ctrllimited, model.actuator_ctrlrange[:, 1], 1.0)
    if model.nv > 1:  # a cart stays on its rail
        start, high = 0.3 * start, 0.02 * high
    command = np.repeat(rng.uniform(-1, 1, (MOST, STEPS // HELD, model.nu)), HELD, axis=1) * high
    acted = {
        "none": lambda c: c,
        "gusts": partial(gusty, rng),
        "delay": lambda c: np.concatenate([c[:, :1], c[:, :1], c[:, :-2]], axis=1),
    }[wrong](command)
    motion = replay(at.physics, *start, acted, np.tile(theta, (MOST, 1)))
    if sensors == "late":
        motion["qvel"] = np.concatenate([motion["qvel"][:, :1], motion["qvel"][:, :-1]], axis=1)
    exact = [np.asarray(motion[k], float)[:n] for k in ("qpos", "qvel")]
    seen = [x + at.sd * rng.normal(size=motion[k].shape)[:n] for k, x in zip(("qpos", "qvel"), exact, strict=True)]
    sd = np.full(2 * model.nv, at.sd)
    if sensors == "counts":
        count = at.sd * 12**0.5  # whose rounding has that standard deviation
        seen[0] = count * np.round(exact[0] / count)
    if sensors != "white":
        seen[1], sd = as_logs(at, *seen, command[:n], sensors == "late", gated)
    return theta, Record(*(jnp.asarray(x, jnp.float32) for x in (*seen, command[:n]))), sd


def as_logs(
    at: System, qpos: np.ndarray, qvel: np.ndarray, command: np.ndarray, fast: bool, gated: bool
) -> tuple[np.ndarray, np.ndarray]:
    """Velocities and the sensors' sd [2 nv] as the loop has them of these logs; fast: velocities were measured."""
    model, logs = at.physics.mj_model, []
    time, channels = at.physics.dt * np.arange(STEPS + 1), Channels.of(model)
    for q, v, c in zip(qpos, qvel, command, strict=True):
        sigma = np.array([noise_level(x) for x in q.T])
        rates, spread = estimate_velocity(time, q, channels, sigma)
        own = (v, np.array([noise_level(x) for x in v.T])) if fast else (rates, spread)
        logs.append(Log("", time, np.concatenate([c, c[-1:]]), q, own[0], fast, channels, sigma, own[1]))
    if gated and fast:
        from bayessim_mjx.logs.velocities import trusted

        logs, _ = trusted(logs, max(model.opt.timestep, at.physics.dt))
    seen, told = np.all([log.seen_speeds for log in logs], axis=0), noise(logs)
    sd = np.concatenate([in_tangent(model, told["qpos"]), np.where(seen, told["qvel"], np.inf)])
    return np.stack([log.qvel for log in logs]), sd


def known(at: System, theta: np.ndarray, rows: Record, wrong: str, q: Distribution | None = None) -> dict[str, Any]:
    """What the exact posterior is worth, where it is known, and how much of it is where q says."""
    if at.ratios is None or wrong != "none":
        return {}
    found = exact(Recorded(at.physics, rows, at.sd, at.ratios), theta)
    out: dict[str, Any] = {"exact": found.gain, "exact level": found.level}
    if q is not None:
        draws = jnp.asarray(found.draws, jnp.float32)
        levels = np.asarray(q.credible_level(draws))
        out["held"] = [float(np.mean(levels <= p)) for p in LEVELS]
        out["divergence"] = float(np.mean(found.gains - np.asarray(q.log_gain(draws))))
    return out


def only_exact(at: System, name: str, seed: int, n: int) -> dict:
    """The same row as `judged`, of the exact posterior."""
    theta, record, _ = recorded(at, seed, "none")
    rows = Record(*(x[:n] for x in (record.qpos, record.qvel, record.command)))
    found = known(at, theta, rows, "none")
    return {"system": name, "wrong": "none", "n": n, "truth": seed} | found


def judged(
    at: System, name: str, seed: int, n: int, wrong: str, draws: int, prior_share: float = PRIOR_SHARE,
    together: int = 1, sensors: str = "white", gated: bool = True,
) -> dict:  # fmt: skip
    """What the refined posterior of the first n trajectories of one truth is worth."""
    clock, began = time.perf_counter(), time.process_time()
    theta, rows, sd = recorded(at, seed, wrong, sensors, n, gated)
    likelihood = Likelihood(at.physics, rows, np.ones((n, STEPS)), sd, together)
    found = refine(Distribution.prior(at.space), likelihood, seed=seed, draws=draws)
    posterior = found.posterior.reduce(COMPONENTS)
    z = (np.asarray(posterior.mean()) - theta) / np.asarray(posterior.sd())
    bare = posterior
    if found.refined.reason is None:
        posterior = dataclasses.replace(posterior, prior_weight=jnp.float32(prior_share))
    truth = jnp.asarray(theta, jnp.float32)
    out = {
        "system": name, "wrong": wrong, "sensors": sensors, "n": n, "truth": seed, "reason": found.refined.reason,
        "level": float(posterior.credible_level(truth)), "gain": float(posterior.log_gain(truth)),
        "bare": float(bare.log_gain(truth)),
        "widening": found.widening, "effective": found.refined.effective, "simulations": found.refined.simulations,
        "sensor": found.noise.sensor.tolist(), "process": found.noise.process.tolist(), "lasting": found.noise.lasting,
        "z": z.tolist(),
    }  # fmt: skip
    out |= known(at, theta, rows, wrong, posterior) if sensors == "white" else {}
    return out | {"seconds": time.perf_counter() - clock, "cpu": time.process_time() - began}


def covered(levels: list[float]) -> str:
    """Shares of truths within the 50, 80 and 95 % regions, with standard errors."""
    if not levels:
        return "|" * len(LEVELS)
    cells = [f"{np.mean(np.array(levels) <= p):.2f} +- {np.sqrt(p * (1 - p) / len(levels)):.2f}" for p in LEVELS]
    return f"| {' | '.join(cells)} "


def gained(gains: list[float]) -> str:
    return f"| {np.mean(gains):.2f} +- {np.std(gains) / len(gains) ** 0.5:.2f} " if gains else "| "


def line(rows: list[dict]) -> str:
    """One row of the table."""
    first, refined = rows[0], [r for r in rows if "gain" in r]
    used = [r for r in refined if r["reason"] is None]
    text = f"| {first['system']} | {first['wrong']} | {first.get('sensors', 'white')} | {first['n']} "
    text += covered([r["level"] for r in used])
    text += gained([r["gain"] for r in refined])
    text += covered([r["exact level"] for r in rows if "exact level" in r])
    text += gained([r["exact"] for r in rows if "exact" in r])
    both = [r for r in used if "held" in r]
    held = " ".join(f"{x:.3f}" for x in np.mean([r["held"] for r in both], axis=0)) if both else ""
    text += f"| {held} " + gained([r["divergence"] for r in both])
    wide = f"{np.median([r['widening'] for r in refined]):.2f}" if refined else ""
    return text + f"| {wide} | {len(rows)} | {len(refined) - len(used)} |"


def _kind(row: dict) -> tuple:
    return row["system"], row["wrong"], row.get("sensors", "white"), row["n"]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--system", nargs="+", default=["linear"], choices=["linear", "damped", "Pendulum", "Cartpole"])
    parser.add_argument("--wrong", nargs="+", default=["none"], choices=list(WRONG), help=str(WRONG))
    parser.add_argument("--sd", type=float, help="of the sensors' noise, in place of the system's own; one per file")
    parser.add_argument("--sensors", nargs="+", default=["white"], choices=SENSORS, help="what the trajectories show")
    parser.add_argument("--ungated", action="store_true", help="velocities that disagree with positions are believed")
    parser.add_argument("--n", nargs="+", type=int, default=[1, 2, 4, 8, 16, 32], help=f"trajectories, at most {MOST}")
    parser.add_argument("--truths", type=int, default=100)
    parser.add_argument("--first", type=int, default=0, help="number of the first truth")
    parser.add_argument("--draws", type=int, default=512, help="thetas of one call (the loop: 1024)")
    parser.add_argument("--prior_share", type=float, default=PRIOR_SHARE, help="as the loop has; one per file")
    parser.add_argument("--together", type=int, default=1, help="trajectories of one call: more of them on a GPU")
    parser.add_argument("--only_exact", action="store_true", help="judge exact posteriors alone, where they are known")
    parser.add_argument("--out", type=Path, default=Path("refinement.json"), help="kept after every truth, taken up")
    a = parser.parse_args()
    rows = json.loads(a.out.read_text()) if a.out.exists() else []
    done = {(*_kind(r), r["truth"]) for r in rows}
    for name in a.system:
        at = system(name)
        at = at if a.sd is None else dataclasses.replace(at, sd=a.sd)
        for seed in range(a.first, a.first + a.truths):
            for wrong, sensors, n in itertools.product(a.wrong, a.sensors, a.n):
                if (name, wrong, sensors, n, seed) in done:
                    continue
                if a.only_exact:
                    rows.append(only_exact(at, name, seed, n))
                else:
                    how = a.draws, a.prior_share, a.together, sensors, not a.ungated
                    rows.append(judged(at, name, seed, n, wrong, *how))
                a.out.write_text(json.dumps(rows))
    parts = [f"{p:.0%}" for p in LEVELS]
    heads = ["system", "wrong", "sensors", "n", *parts, "gain, nats", *(f"exact {p}" for p in parts), "exact gain"]
    heads += ["holds of the exact", "divergence"]
    print(f"| {' | '.join([*heads, 'widening', 'truths', 'not refined'])} |\n{'|---' * (len(heads) + 3)}|")
    for key in sorted({_kind(r) for r in rows}):
        print(line([r for r in rows if _kind(r) == key]))


if __name__ == "__main__":
    main()
