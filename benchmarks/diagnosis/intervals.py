"""Do 90 % intervals of a diagnosis cover? Shares of the gap from few operating conditions, return recovered from few
trainings, and the t of a comparison where nothing differs.

    python benchmarks/diagnosis/intervals.py > figures            # four minutes on one core

The rule for shares was chosen on log-normal gaps and on the cases below that are named in CHOSEN; it saw none of the
others. Systems are simulated in MuJoCo C: a hidden friction, payload and weak motor, of which the corrected simulator
knows a part, while a controller follows another motion in each condition. 1500 conditions are "all", and their share
is the truth.
"""

import argparse

import mujoco
import numpy as np

from bayessim_mjx.closed_loop import measures
from bayessim_mjx.diagnosis import statistics
from bayessim_mjx.diagnosis.selection import heldout

COUNTS = (2, 3, 4, 5, 8)
SIGMA, PERIOD, STEPS, WINDOWS = 4e-4, 0.02, 25, 6  # rad, s, control steps of a window, windows of a condition
POPULATION, TORQUE = 1500, 8.0  # conditions; N m or N, of the drives

CHOSEN = ("pendulum", "slider", "gamma", "pareto", "half silent", "student")
XML = """<mujoco><option timestep=".01" integrator="implicitfast"/>
<default><geom contype="0" conaffinity="0"/></default><worldbody>%s</worldbody></mujoco>"""
LINK = """<geom type="capsule" size=".02" fromto="0 0 0 0 0 -.5" mass="%g"/>"""
# (bodies with dry friction, mass and gear to be put in; gains of the controller; real, recalibrated, corrected)
SYSTEMS = {
    "pendulum": (
        '<body><joint name="a" axis="0 1 0" damping=".02" frictionloss="%g"/>' + LINK + "</body>",
        (20.0, 2.0), (0.05, 0.55, 0.85), (0.0, 0.5, 1.0), (0.05, 0.5, 0.9),
    ),
    "slider": (
        '<body><joint name="a" type="slide" axis="1 0 0" damping="1" frictionloss="%g"/>'
        '<geom type="box" size=".1 .1 .1" mass="%g"/></body>',
        (20.0, 2.0), (3.0, 1.2, 1.0), (0.0, 1.0, 1.0), (3.0, 1.0, 1.0),
    ),
    "arm": (
        '<body><joint name="a" axis="0 1 0" damping=".1" frictionloss="%g"/>'
        '<geom type="capsule" size=".03" fromto="0 0 0 0 0 -.4" mass="1"/><body pos="0 0 -.4">'
        '<joint name="b" axis="0 1 0" damping=".05" armature=".02" frictionloss=".02"/>' + LINK + "</body></body>",
        (8.0, 1.0), (0.2, 0.7, 0.8), (0.0, 0.5, 1.0), (0.17, 0.5, 0.8),
    ),
    "cart with pole": (
        '<body><joint name="a" type="slide" axis="1 0 0" damping=".5" frictionloss="%g"/>'
        '<geom type="box" size=".1 .1 .1" mass="1"/><body><joint name="free" axis="0 1 0" damping=".01"/>'
        + LINK + "</body></body>",
        (20.0, 5.0), (0.8, 0.3, 0.95), (0.0, 0.25, 1.0), (0.8, 0.25, 0.95),
    ),
    "sprung wheel": (
        '<body><joint name="a" axis="0 1 0" damping=".05" stiffness="2" frictionloss="%g"/>'
        '<geom type="cylinder" size=".15 .02" mass="%g"/></body>',
        (5.0, 0.5), (0.1, 1.3, 0.9), (0.0, 1.0, 1.0), (0.07, 1.3, 1.0),
    ),
}  # fmt: skip


def simulated(name: str, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Mean squares before and after in noise units, `[POPULATION, WINDOWS]`."""
    bodies, (kp, kd), *values = SYSTEMS[name]
    models = []
    for friction, mass, gear in values:
        model = mujoco.MjSpec.from_string(XML % (bodies % (friction, mass)))
        for joint in model.joints:
            if joint.name != "free":
                motor = model.add_actuator(target=joint.name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
                motor.gear[0] = gear
        models.append(model.compile())
    data = [mujoco.MjData(m) for m in models]
    nq, nu, out = models[0].nq, models[0].nu, np.zeros((2, POPULATION, WINDOWS))
    for c in range(POPULATION):
        size, rate = 0.4 * np.exp(0.7 * rng.normal()), 2 * np.pi * np.exp(rng.uniform(np.log(0.1), np.log(1.0)))
        mix = rng.normal(size=(nu, 3)) / 2
        mujoco.mj_resetData(models[0], data[0])
        for w in range(WINDOWS):
            for d in data[1:]:
                d.qpos[:], d.qvel[:], d.time = data[0].qpos, data[0].qvel, data[0].time
            errors = np.zeros((2, STEPS, nq))
            for k in range(STEPS):
                target = size * mix @ np.sin(rate * data[0].time * np.array([1.0, 1.7, 3.1]))
                command = np.clip(kp * (target - data[0].qpos[:nu]) - kd * data[0].qvel[:nu], -TORQUE, TORQUE)
                for m, d in zip(models, data, strict=True):
                    d.ctrl[:] = command
                    mujoco.mj_step(m, d, round(PERIOD / m.opt.timestep))
                seen = data[0].qpos + SIGMA * rng.normal(size=nq)
                errors[:, k] = [(seen - d.qpos) / SIGMA for d in data[1:]]
            out[:, c, w] = np.mean(errors**2, axis=(1, 2))
    return out[0], out[1]


FAMILIES = {  # gaps of conditions in noise units, and shares left of them
    "weibull": lambda r, n: (20 * r.weibull(0.6, n), r.beta(2, 4, n)),
    "two kinds": lambda r, n: (np.where(r.random(n) < 0.8, 5, 60) * np.exp(0.5 * r.normal(size=n)), r.beta(1, 4, n)),
    "hard ones": lambda r, n: ((g := 10 * r.gamma(0.8, size=n)), np.minimum(0.02 + 0.004 * g, 1.0)),
    "gamma": lambda r, n: (30 * r.gamma(0.5, size=n), r.beta(2, 6, n)),
    "pareto": lambda r, n: (5 * (1 + r.pareto(2.5, n)), r.beta(1, 9, n)),
    "half silent": lambda r, n: (np.where(r.random(n) < 0.5, 0.2, r.gamma(2, 40, n)), r.beta(3, 3, n)),
    "student": lambda r, n: (10 * np.exp(np.clip(r.standard_t(4, n), -6, 6)), r.beta(1, 3, n)),
}


def drawn(name: str, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Other families of heavy tails: gaps of conditions, shares left of them, and windows."""
    many = (4 * POPULATION, WINDOWS)
    size, left = FAMILIES[name](rng, many[0])
    each = rng.gamma(1.5, size=many) / 1.5
    noise = rng.chisquare(25, size=(2, *many)) / 25
    before = noise[0] + size[:, None] * each
    return before, noise[1] + (left * size)[:, None] * each * rng.gamma(4, size=many) / 4


def old(before: np.ndarray, after: np.ndarray, group: np.ndarray, rng: np.random.Generator) -> tuple[float, float]:
    """What was done before: a Bayesian bootstrap, of windows below five conditions."""
    index = group if len(np.unique(group)) >= 5 else np.arange(len(group))
    draws = rng.dirichlet(np.ones(index.max() + 1), size=400)[:, index] * (index.max() + 1)
    samples = (draws @ (before - after)) / np.maximum(draws @ (before - 1.0), 1e-9)
    low, high = np.quantile(np.clip(samples, -1, 1), [0.05, 0.95])
    return float(low), float(high)


def shares(repeats: int, seed: int) -> None:
    """Coverage of shares of the gap closed."""
    print("share of the gap closed, nominal 90 %; in brackets a bootstrap of windows below five conditions")
    print(f"{'':16}{'truth':>6}", *(f"{g:>12}" for g in COUNTS))
    other = [n for n in (*SYSTEMS, *FAMILIES) if n not in CHOSEN]
    for name in (*other, *CHOSEN):
        rng = np.random.default_rng(seed)
        before, after = (simulated if name in SYSTEMS else drawn)(name, rng)
        truth = 1 - (after.mean() - 1) / (before.mean() - 1)
        row = []
        for g in COUNTS:
            hits = []
            for _ in range(repeats):
                own = rng.choice(len(before), g, replace=False)
                few = np.arange(WINDOWS) < rng.integers(3, WINDOWS + 1, size=(g, 1))  # logs of different lengths
                group = np.repeat(np.arange(g), few.sum(1))
                b, a = before[own][few], after[own][few]
                ends = heldout.Closed(b, a, group).interval(), old(b, a, group, rng)
                hits.append([low <= truth <= high for low, high in ends])
            new, was = np.mean(hits, axis=0)
            row.append(f"{new:>6.2f} ({was:.2f})")
        print(f"{name:16}{truth:>6.2f}", *row, "chosen on" if name in CHOSEN else "")


def recovered(repeats: int, seed: int) -> None:
    """Coverage of the return recovered: trainings that are normal, skewed, heavy-tailed, or fail in one of seven."""
    kinds = {
        "normal": lambda r, n: r.normal(size=n),
        "skewed": lambda r, n: 1 - r.gamma(1.0, size=n),
        "heavy": lambda r, n: r.standard_t(3, size=n) / 3**0.5,
        "failing": lambda r, n: np.where(r.random(n) < 0.15, -3.0, 0.45 / 0.85) + 0.3 * r.normal(size=n),
    }
    means = {"nominal": 0.0, "corrected": 8.0, "wide": 3.0, "oracle": 10.0}
    print("\nreturn recovered, nominal 90 %; trainings by seeds of each kind")
    print(f"{'':14}", *(f"{k:>6}" for k in (5, 8)))
    for name, kind in kinds.items():
        rng, row = np.random.default_rng(seed), []
        for k in (5, 8):
            hits = []
            for _ in range(repeats):
                episodes = rng.normal(size=16)
                real = {r: m + kind(rng, (k, 1)) + episodes + 0.5 * rng.normal(size=(k, 16)) for r, m in means.items()}
                ends = measures.recovery(real)["corrected"]["ci"]
                hits += [] if ends is None else [ends[0] <= 0.8 <= ends[1]]
            row.append(f"{np.mean(hits):>6.2f}")
        print(f"{name:14}", *row)


def false_alarms(repeats: int, seed: int) -> None:
    """How often the t of a comparison says more than 2 where two models predict equally well (2.3 %)."""
    print("\nt > 2 where nothing differs: 2.3 % by the normal law")
    for name, kind in (("normal", lambda r, n: r.normal(size=n)), ("heavy", lambda r, n: r.standard_t(3, size=n))):
        rng, row = np.random.default_rng(seed), []
        for g in COUNTS:
            group = np.repeat(np.arange(g), WINDOWS)
            x = [kind(rng, g)[group] + kind(rng, len(group)) for _ in range(repeats)]
            row.append(f"{100 * np.mean([statistics.normal_deviate(v, group) > 2.0 for v in x]):>5.1f} %")
        print(f"{name:14}", *row)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--repeats", type=int, default=1000, help="intervals per figure")
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    for measure in (shares, recovered, false_alarms):
        measure(args.repeats, args.seed)
