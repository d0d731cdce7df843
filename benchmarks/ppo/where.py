"""Where the time of an update goes, for each task, and what each way to make a part cheaper saves.

    python benchmarks/ppo/where.py --tasks Humanoid Anymal --worlds 4096

Milliseconds are of one update (`num_steps` control steps in all worlds, then all epochs), medians of five. Every task
has a process of its own. Lines of JSON, as they come:

- *update*: of training as it is, compilation apart; memory at its most.
- *physics*: `mjx.step` alone, with parameters of each world's own; without contacts, without constraints at all;
  carrying all of `mjx.Data` on; with room for as many contacts as there were (`--margin` times the most that any world
  had), if there were any.
- *policy*, *sgd*: networks of float32 and of bfloat16 (`ppo.precision`); epochs of more, smaller minibatches.
- *unroll*: a rollout, timesteps in a loop and in a row (`env.unroll`), with the seconds of its compilation.

With `env.impl=warp`: the update, a rollout and Warp's timesteps alone.
"""

import argparse
import json
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import jax
import mujoco
import numpy as np
from limits import bare_own, built, memory, seconds
from mujoco import mjx

from bayessim_mjx import config, registry
from bayessim_mjx.rl import losses, networks, policy_of, ppo, transitions
from bayessim_mjx.rl.catalogue import learner
from bayessim_mjx.rl.worlds import gather

TASKS = {
    "Ant": 4096, "Humanoid": 4096, "Anymal": 4096, "BallBalance": 4096, "FrankaCabinet": 4096, "ShadowHand": 16384,
}  # fmt: skip
FINER = (2, 4, 16)  # times as many minibatches
LOOKS = 10  # updates after which contacts are counted, one after the other


def say(row: dict[str, Any]) -> None:
    print(json.dumps(row), flush=True)


def ms(run: Callable[[], Any]) -> float:
    return round(1e3 * seconds(run), 2)


class Setting:
    """A task with its own settings, the compiled update, and a state, at first before any update."""

    def __init__(self, task: str, worlds: int, overrides: list[str]) -> None:
        self.settings = config.load(task, overrides=[f"env.numEnvs={worlds}", *overrides])
        self.env, self.ppo = registry.make(task, config=self.settings), self.settings.ppo
        self.named = {"task": task, "worlds": worlds, "device": jax.devices()[0].device_kind}
        substeps = self.env.physics.substeps
        self.named |= {"steps": self.ppo.num_steps, "substeps": substeps}
        self.timesteps = self.ppo.num_steps * substeps
        init, first = built(lambda key: ppo.init(self.env, self.ppo, key), jax.random.PRNGKey(0))
        self.state = init(jax.random.PRNGKey(0))
        self.update, later = built(lambda state: ppo.update(self.env, self.ppo, state, None), self.state)
        update = ms(lambda: self.update(self.state))
        row = {"update_ms": update, "peak_mib": memory(), "init": first, "update": later}
        self.say("update", row | {"minibatches": self.ppo.num_minibatches, "epochs": self.ppo.num_epochs})

    def say(self, name: str, row: dict[str, Any]) -> None:
        say({"row": name} | self.named | row)


def physics(setting: Setting, *given: Any, lean: bool = True) -> float:
    """Milliseconds of an update's timesteps; given: as for `limits.bare_own`."""
    return ms(bare_own(setting.env, setting.state, setting.timesteps, *given, lean=lean))


def without(setting: Setting, flag: str) -> float:
    """Physics with this part of it switched off."""

    def model_of(world: Any) -> mjx.Model:
        model = setting.env.physics.model_of(world)
        own = model.opt.disableflags
        off = type(own)(own | int(getattr(mujoco.mjtDisableBit, f"mjDSBL_{flag}")))
        return model.tree_replace({"opt.disableflags": off})

    return physics(setting, model_of)


def touching(setting: Setting) -> list[int]:
    """Most contacts of a world that are active, after each of some updates."""
    own = setting.env.physics

    @jax.jit
    def count(worlds: Any) -> jax.Array:
        def one(world: Any) -> jax.Array:
            contact = mjx.step(own.model_of(world), own.data_of(world))._impl.contact
            return (contact.dist < contact.includemargin).sum()

        return jax.vmap(one)(worlds).max()

    found, state = [], setting.state
    for _ in range(LOOKS):
        state = setting.update(state)[0]
        found.append(int(count(state.env_states.pipeline_state)))
    setting.state = state
    return found


def parts_of_physics(setting: Setting, margin: float) -> None:
    """What contacts and constraints cost, and what lean states and room for fewer contacts save."""
    own = setting.env.physics
    room, most, opt = int(own.template._impl.contact.dist.shape[0]), touching(setting), own.mj_model.opt
    rows = int(jax.eval_shape(lambda: mjx.step(own.model, own.template))._impl.efc_J.shape[0])
    setting.say(
        "rows", {"contacts": room, "active": most, "rows": rows, "iterations": [opt.iterations, opt.ls_iterations]}
    )
    setting.say("physics", {"ms": physics(setting)})
    setting.say("physics", {"without": "contacts", "ms": without(setting, "CONTACT")})
    setting.say("physics", {"without": "constraints", "ms": without(setting, "CONSTRAINT")})
    setting.say("physics", {"carried": "all", "ms": physics(setting, lean=False)})
    budget = int(np.ceil(margin * max(most)))
    if 0 < budget < room:
        spec = setting.env.spec()
        for old in [n for n in spec.numerics if n.name == "max_contact_points"]:
            spec.delete(old)
        spec.add_numeric(name="max_contact_points", data=[budget], size=1)
        compiled = spec.compile()
        model, fewer = mjx.put_model(compiled, impl="jax"), mjx.make_data(compiled, impl="jax")
        found = physics(setting, lambda world: model.tree_replace(world.fields), fewer)
        setting.say("physics", {"room": budget, "ms": found})


def networks_alone(setting: Setting) -> None:
    """The policy in a rollout, and the epochs, in both precisions and in smaller minibatches."""
    states, env = setting.state, setting.env
    obs = {name: value for name, value in states.env_states.obs.items() if name == "policy"}
    for precision in ("float32", "bfloat16"):
        policy = policy_of(states).replace(half=precision == "bfloat16")

        @jax.jit
        def run(policy: networks.Policy, obs: Any) -> Any:
            def step(seen: Any, _: None) -> tuple[Any, None]:
                mean = policy.distribution(seen)[0]
                return {"policy": seen["policy"] + 1e-6 * mean.mean(-1, keepdims=True)}, None  # so each step counts

            return jax.lax.scan(step, obs, length=setting.ppo.num_steps)[0]

        setting.say("policy", {"precision": precision, "ms": ms(partial(run, policy, obs))})
    plain = learner(env, setting.ppo)
    data = jax.jit(lambda state: gather(plain, state, None, state.key)[1])(states)
    forms = [("float32", 1), ("bfloat16", 1), *(("float32", k) for k in FINER)]
    for precision, finer in forms:
        changed = replace(setting.ppo, precision=precision, num_minibatches=setting.ppo.num_minibatches * finer)
        own = learner(env, changed)

        @partial(jax.jit, static_argnums=2)
        def learn(state: Any, data: Any, own: Any) -> Any:
            normalizer = transitions.statistics(own.config, state, data)
            batch = transitions.batch(own, state, data, normalizer)
            return losses.optimise(state.key, state.params, state.opt_state, state.learning_rate, batch, own)

        taken = ms(partial(learn, states.replace(config=changed), data, own))
        setting.say("sgd", {"precision": precision, "minibatches": changed.num_minibatches, "ms": taken})


def unrolled(setting: Setting, *ways: bool) -> None:
    """A rollout with timesteps in a loop (False) and in a row."""
    for unroll in ways:
        env = registry.make(setting.named["task"], config=setting.settings, unroll=unroll)
        own = learner(env, setting.ppo)
        collect, compiling = built(lambda state, own=own: gather(own, state, None, state.key), setting.state)
        setting.say("unroll", {"unroll": unroll, "ms": ms(partial(collect, setting.state)), "compiling": compiling})


def measure(task: str, worlds: int, overrides: list[str], margin: float) -> None:
    setting = Setting(task, worlds, overrides)
    if setting.env.physics.warp is not None:  # computes timesteps as a whole: there are no parts to leave out
        unrolled(setting, False)
        setting.say("physics", {"impl": "warp", "ms": physics(setting)})
        return
    unrolled(setting, False, True)
    networks_alone(setting)
    parts_of_physics(setting, margin)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tasks", nargs="+", choices=list(TASKS), default=list(TASKS))
    parser.add_argument("--worlds", type=int, help="by default those of published trainings")
    parser.add_argument("--margin", type=float, default=1.25, help="room for contacts, times the most there were")
    parser.add_argument("--alone", action="store_true", help=argparse.SUPPRESS)
    overrides = [word for word in sys.argv[1:] if "=" in word and not word.startswith("-")]  # key=value, anywhere
    args = parser.parse_args([word for word in sys.argv[1:] if word not in overrides])
    if args.alone:
        measure(args.tasks[0], args.worlds or TASKS[args.tasks[0]], overrides, args.margin)
        return
    for task in args.tasks:
        worlds = [] if args.worlds is None else ["--worlds", str(args.worlds)]
        words = ["--tasks", task, "--margin", str(args.margin), *worlds, *overrides]
        if subprocess.run([sys.executable, __file__, "--alone", *words], check=False).returncode:
            say({"task": task, "failed": True})


if __name__ == "__main__":
    main()
