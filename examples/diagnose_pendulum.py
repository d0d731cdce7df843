"""A pendulum with a sticky bearing and a weak motor: find out from its motion, correct the simulator, and look again.

    python examples/diagnose_pendulum.py [--out DIR] [flags and settings of diagnose]

The "real" pendulum is MuJoCo's own (in C, at a tenth of the step), with native friction and gain. Takes about five
minutes on a laptop, most of it compilation.
"""

import argparse
import tempfile
from pathlib import Path

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from bayessim_mjx import diagnose, registry, rl
from bayessim_mjx.config import load
from bayessim_mjx.diagnosis.result import load as load_diagnosis
from bayessim_mjx.env import Task
from bayessim_mjx.quantities import estimate

FRICTION, GAIN = 0.15, 0.7  # N m; of the torque commanded
SECONDS, RUNS, NOISE = 6.0, 8, 2e-3  # s, logs, rad


def real_pendulum(env: Task) -> mujoco.MjModel:
    """Make the pendulum that stands on the bench."""
    spec = env.spec()
    spec.option.timestep = env.dt / 10
    spec.option.disableflags = int(mujoco.mjtDisableBit.mjDSBL_CONTACT)  # friction is a constraint: these are on
    spec.option.iterations = 100
    spec.joints[0].frictionloss = FRICTION
    spec.actuators[0].gainprm[0] *= GAIN
    return spec.compile()


def record(model: mujoco.MjModel, dt: float, folder: Path) -> None:
    """CSV logs of sums of sines of torque about the lower rest, where the task's long step is accurate enough."""
    folder.mkdir(parents=True, exist_ok=True)
    rng = np.random.default_rng(0)
    for run in range(RUNS):
        data = mujoco.MjData(model)
        data.qpos[0] = np.pi + rng.uniform(-0.5, 0.5)
        size, rate, phase = rng.uniform((0.3, 0.5, 0), (0.7, 5.0, 6.3), (3, 3)).T
        rows = []
        for k in range(round(SECONDS / dt)):
            data.ctrl[0] = np.clip(np.sum(size * np.sin(rate * k * dt + phase)), -2, 2)
            rows.append((k * dt, data.ctrl[0], data.qpos[0] + NOISE * rng.normal()))
            mujoco.mj_step(model, data, 10)
        np.savetxt(folder / f"run{run}.csv", rows, delimiter=",", header="time,ctrl:torque,qpos:hinge", comments="")


def returns(env: Task, policy: rl.Policy) -> float:
    """Mean over 64 episodes at nominal physics, the same starts everywhere."""
    thetas = jnp.tile(jnp.asarray(env.space.nominal), (64, 1))
    return float(rl.evaluate(env, policy, jax.random.PRNGKey(1), thetas)["return"].mean())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, help="logs and results (default: a temporary folder)")
    args, more = parser.parse_known_args()
    out = args.out or Path(tempfile.mkdtemp(prefix="diagnose_"))
    plain = registry.make("Pendulum", config=load("Pendulum", overrides=["task.randomize=False"]))
    assert isinstance(plain, Task)
    record(real_pendulum(plain), plain.dt, out / "logs")

    candidates = "coulomb_friction,viscous_friction,actuator_gain,actuator_delay,joint_offset"
    # a weaker motor moves a link like a stronger motor moves a heavier one, so what is known of the link is stated
    given = ["--task", "Pendulum", "--data", str(out / "logs"), "--accuracy", "5%"]
    given += ["--effects", candidates, "--out", str(out / "found")]
    if code := diagnose.main([*given, *more]):
        raise SystemExit(code)
    found = load_diagnosis(out / "found")
    print(f"\nverdict: {found.verdict}; truth: coulomb_friction {FRICTION} N m, actuator_gain {GAIN}")
    for effect in found.effects:
        values = ", ".join(f"{name} {estimate(e.mean, e.sd)} {e.unit}" for name, e in effect.parameters.items())
        print(f"  {effect.name} at {effect.where}: {values}")

    settings = load("Pendulum", overrides=[f"effects={out / 'found' / 'effects.yaml'}", "task.randomize=False"])
    corrected = registry.make("Pendulum", config=settings)
    assert isinstance(corrected, Task)
    policy, _ = rl.train(plain, settings.ppo, jax.random.PRNGKey(0), iterations=settings.ppo.max_iterations)
    before, after = returns(plain, policy), returns(corrected, policy)
    print(f"a policy of the plain simulator: it predicts a return of {before:.0f}, the corrected one {after:.0f}")
    command = f"bayessim-mjx gap-loop --task Pendulum --diagnosis {out / 'found'} --real {out / 'logs'}"
    print(f"what retraining recovers: {command}")


if __name__ == "__main__":
    main()
