"""Trainings on several devices, in a process of their own: `python sharded.py curves|process ...`; see test_devices."""

import functools
import json
import os
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[2]))  # a program, which pytest does not start


@functools.cache
def walk():
    """One environment, so that a second training of a kind compiles nothing."""
    from tests.rl import probes

    env = probes.Walk()
    env.dt = 1.0
    return env


def training(devices, state=None, folder=None):
    """(metrics of three log intervals, state) with `devices` of them; from a saved state, where there is one."""
    import jax

    from bayessim_mjx import device, rl
    from bayessim_mjx.config import PPOConfig, RNDConfig
    from bayessim_mjx.runs import checkpoints

    env = walk()
    config = PPOConfig(
        num_envs=128, num_steps=8, num_epochs=2, num_minibatches=2, hidden_actor=(8,), hidden_critic=(8,),
        log_interval=2, rnd=RNDConfig(num_outputs=2, predictor_hidden_dims=(8,), target_hidden_dims=(8,), weight=0.1),
    )  # fmt: skip
    curve, key = [], jax.random.PRNGKey(1)
    mesh = device.mesh_of(jax.devices()[:devices])
    start = rl.init(env, config, key, None, mesh)
    if folder is not None:
        start = checkpoints.restore(Path(folder), start)[0]
    state, _ = rl.run(env, config, start, None, 6, progress=lambda metrics, _: curve.append(metrics))
    return [{k: v for k, v in m.items() if not k.startswith("Perf/")} for m in curve], state


def where(state):
    """How many devices hold the worlds' states and the parameters, and whether each holds all of them."""
    leaves = {"worlds": state.env_states.reward, "parameters": state.params["actor"]["log_std"]}
    return {name: [len(x.sharding.device_set), x.is_fully_replicated] for name, x in leaves.items()}


def curves(folder):
    """Of 1 and 2 devices; and on each what follows a checkpoint of 2."""
    from bayessim_mjx.runs import checkpoints

    runs = {n: training(n) for n in (1, 2)}
    checkpoints.save(Path(folder) / "saved", runs[2][1], 6, {})
    resumed = {n: training(n, folder=Path(folder) / "saved")[0] for n in (1, 2)}
    return {"curves": {n: run[0] for n, run in runs.items()}, "resumed": resumed, "where": where(runs[2][1])}


def process(folder, address, number, count):
    """One of several processes; its curve, and a checkpoint of its own."""
    import jax

    os.environ |= {
        "JAX_COORDINATOR_ADDRESS": address, "JAX_PROCESS_ID": number, "JAX_NUM_PROCESSES": count
    }  # fmt: skip
    from bayessim_mjx import device
    from bayessim_mjx.config import Config
    from bayessim_mjx.runs import checkpoints

    device.setup_jax(Config(device="cpu", devices="all", cache_dir="off"))
    curve, state = training(len(jax.devices()))
    checkpoints.save(Path(folder) / f"saved{number}", state, 6, {})
    return {"curve": curve, "devices": len(jax.devices()), "where": where(state)}


if __name__ == "__main__":
    what, out, *rest = sys.argv[1:]
    found = {"curves": curves, "process": process}[what](str(Path(out).parent), *rest)
    Path(out).write_text(json.dumps(found))
