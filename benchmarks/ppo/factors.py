"""What small matrix factorisations cost a step: MJX as it comes, and as the library has it (`compat`).

    python benchmarks/ppo/factors.py --worlds 64 4096

Chains of links about two axes in turn, with and without dry friction; both forms in one process, in turns. Prints the
microseconds of a step of all worlds (the least of the turns), their ratio, and how far the two end apart.
"""

import argparse
import time
from collections.abc import Callable

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from mujoco.mjx._src import forward, smooth, solver

from bayessim_mjx.compat import compiler_options, mjx

MODULES = (forward, smooth, solver)
STEPS = 50
LINK = """<body pos="0 0 -.3"><joint name="j{i}" axis="0 1 {tilt}" damping=".1" frictionloss="{friction}"/>
  <geom type="capsule" fromto="0 0 0 0 0 -.3" size=".02" contype="0" conaffinity="0"/>{body}</body>"""


def chain(links: int, friction: float) -> mujoco.MjModel:
    body = ""
    for i in reversed(range(links)):
        body = LINK.format(i=i, tilt=i % 2, friction=friction, body=body)
    motors = "".join(f'<motor joint="j{i}"/>' for i in range(links))
    options = '<option integrator="implicitfast" timestep=".0025" iterations="8" ls_iterations="8" jacobian="dense"/>'
    xml = f"<mujoco>{options}<worldbody>{body}</worldbody><actuator>{motors}</actuator></mujoco>"
    return mujoco.MjModel.from_xml_string(xml)


def rollout(model: mujoco.MjModel) -> Callable[[np.ndarray, np.ndarray], jax.Array]:
    put, data = mjx.put_model(model), mjx.make_data(model)

    def one(q: jax.Array, u: jax.Array) -> jax.Array:
        def step(world: mjx.Data, _: None) -> tuple[mjx.Data, None]:
            return mjx.step(put, world), None

        return jax.lax.scan(step, data.replace(qpos=q, ctrl=u), None, STEPS)[0].qpos

    return jax.jit(jax.vmap(one), compiler_options=compiler_options())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--worlds", type=int, nargs="+", default=[64, 4096])
    parser.add_argument("--links", type=int, nargs="+", default=[1, 2, 4, 6, 8])
    parser.add_argument("--turns", type=int, default=7)
    args = parser.parse_args()
    written_out = {module: module.jax for module in MODULES}
    print(f"{jax.devices()[0].device_kind}, us for a step of all worlds")
    print("| joints | dry friction | worlds | MJX | written out | ratio | apart, rad |\n|---|---|---|---|---|---|---|")
    for links, friction, worlds in ((n, f, w) for n in args.links for f in (0.0, 0.1) for w in args.worlds):
        model, rng = chain(links, friction), np.random.default_rng(0)
        asked = rng.uniform(-1, 1, (2, worlds, links)).astype(np.float32)
        runs, ends = [], []
        for given in (dict.fromkeys(MODULES, jax), written_out):
            for module, own in given.items():
                module.jax = own
            runs.append(rollout(model))
            ends.append(np.asarray(jax.block_until_ready(runs[-1](*asked))))
        best = [np.inf, np.inf]
        for _ in range(args.turns):
            for k, run in enumerate(runs):
                began = time.perf_counter()
                jax.block_until_ready(run(*jnp.asarray(asked)))
                best[k] = min(best[k], (time.perf_counter() - began) / STEPS * 1e6)
        row = links, "yes" if friction else "no", worlds, *(f"{x:.0f}" for x in best), f"{best[1] / best[0]:.2f}"
        print("|", " | ".join(map(str, row)), f"| {np.abs(ends[0] - ends[1]).max():.0e} |", flush=True)


if __name__ == "__main__":
    main()
