"""How many mistakes of deployment does `policy check` name, and how many right deployments does it accuse?

    python benchmarks/wrappers/policy_contract.py [--seed N] [--only NAME] [--record FILE] [--keep DIR]

40 mistakes and 20 right deployments of four robots with untrained policies. A mistake is named if the findings are
exactly the planted ones: part, kind, entries, and amount within 10 %. See deployments.py for the control code.
"""

import argparse
import json
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import deployments as d
import numpy as np
from deployment_logs import record

from bayessim_mjx import registry
from bayessim_mjx.contract.check import check
from bayessim_mjx.contract.evidence import Result

HERE = Path(__file__).parent
JOINTS = [f"{leg}_{joint}" for leg in d.LEGS for joint in ("HAA", "HFE", "KFE")]
PLACES, SPEEDS = [f"{j}_position" for j in JOINTS], [f"{j}_velocity" for j in JOINTS]
GYRO, GRAVITY, SPEED = ([f"{n}_{i}" for i in "xyz"] for n in ("angular_velocity", "gravity", "velocity"))
QUATERNION, ROTORS = [f"quaternion_{i}" for i in "xyzw"], [f"rotor_{a}{k}" for k in range(4) for a in ("pitch", "roll")]
Truth = list[tuple[str, str, list[str], Any]]
Plant = Callable[[np.random.Generator], tuple[dict[str, Any], Truth]]


def obs(kind: str, entries: list[str], found: Any = None) -> tuple[str, str, list[str], Any]:
    return ("observation", kind, entries, found)


def fixed(name: str, *truth: tuple[str, str, list[str], Any], amount: Any = True) -> Plant:
    return lambda rng: ({name: amount}, list(truth))


def pair(rng: np.random.Generator, count: int) -> list[int]:
    return sorted(map(int, rng.choice(count, 2, replace=False)))


def swapped(rng: np.random.Generator) -> tuple[dict[str, Any], Truth]:
    i, j = pair(rng, 12)
    return {"joints_swapped": (i, j)}, [obs("order", [PLACES[i], PLACES[j]]), obs("order", [SPEEDS[i], SPEEDS[j]])]


def rotors_swapped(rng: np.random.Generator) -> tuple[dict[str, Any], Truth]:
    i, j = pair(rng, 8)
    return {"joints_swapped": (i, j)}, [obs("order", [f"{ROTORS[i]}_position", f"{ROTORS[j]}_position"])]


def in_robot_order(rng: np.random.Generator) -> tuple[dict[str, Any], Truth]:
    middle = slice(3, 9)
    return {"legs_in_robot_order": True}, [obs("order", PLACES[middle]), obs("order", SPEEDS[middle])]


def hip(rng: np.random.Generator) -> tuple[dict[str, Any], Truth]:
    i = 3 * int(rng.integers(4))
    return {"joint_sign": i}, [obs("sign", [PLACES[i]]), obs("sign", [SPEEDS[i]])]


def drive_sign(rng: np.random.Generator) -> tuple[dict[str, Any], Truth]:
    i = int(rng.integers(12))
    return {"actuator_sign": i}, [("command", "sign", [JOINTS[i]], None)]


def cables(rng: np.random.Generator) -> tuple[dict[str, Any], Truth]:
    i, j = pair(rng, 12)
    return {"cables_swapped": (i, j)}, [("motion", "order", [JOINTS[i], JOINTS[j]], None)]


def motor(rng: np.random.Generator) -> tuple[dict[str, Any], Truth]:
    i = int(rng.integers(12))
    return {"motor_reversed": i}, [("motion", "sign", [JOINTS[i]], None)]


def drives_swapped(rng: np.random.Generator) -> tuple[dict[str, Any], Truth]:
    i, j = pair(rng, 12)
    return {"actuators_swapped": (i, j)}, [("command", "order", [JOINTS[i], JOINTS[j]], None)]


def encoder_zero(rng: np.random.Generator) -> tuple[dict[str, Any], Truth]:
    i, by = int(rng.integers(12)), float(rng.uniform(0.1, 0.4) * rng.choice([-1, 1]))
    return {"encoder_zero": (i, by)}, [obs("offset", [PLACES[i]], by)]


def encoder_dead(rng: np.random.Generator) -> tuple[dict[str, Any], Truth]:
    i = int(rng.integers(12))
    return {"encoder_dead": i}, [obs("frozen", [PLACES[i]])]


def mounted(rng: np.random.Generator) -> tuple[dict[str, Any], Truth]:
    turns = {
        "90 degrees about z": [0, -1, 0, 1, 0, 0, 0, 0, 1], "90 degrees about -z": [0, 1, 0, -1, 0, 0, 0, 0, 1],
        "180 degrees about x": [1, 0, 0, 0, -1, 0, 0, 0, -1], "180 degrees about z": [-1, 0, 0, 0, -1, 0, 0, 0, 1],
    }  # fmt: skip
    text = str(rng.choice(list(turns)))
    return {"imu_mounted": turns[text]}, [obs("axes", GYRO, text), obs("axes", GRAVITY, text)]


def amount(name: str, low: float, high: float, *truth: tuple, of: Callable[[float], Any] = float) -> Plant:
    """A mistake whose amount is drawn; it is the finding's number where that is `"amount"`."""

    def plant(rng: np.random.Generator) -> tuple[dict[str, Any], Truth]:
        value = float(rng.uniform(low, high))
        return {name: value}, [(p, k, e, of(value) if f == "amount" else f) for p, k, e, f in truth]

    return plant


def late(name: str, *truth: tuple) -> Plant:
    def plant(rng: np.random.Generator) -> tuple[dict[str, Any], Truth]:
        steps = int(rng.integers(1, 3))
        return {name: steps}, [(p, k, e, float(steps)) for p, k, e, _ in truth]

    return plant


def scales(rng: np.random.Generator) -> tuple[dict[str, Any], Truth]:
    factor = float(rng.choice([0.5, 2.0, 0.7, 1.4]))
    return {"action_scale": factor}, [
        ("command", "scale_missing" if factor == 2.0 else "scale_twice" if factor == 0.5 else "scale", JOINTS, None)
    ]


MISTAKES: list[tuple[str, str, Plant]] = [
    ("joints swapped", "Anymal", swapped),
    ("legs in the robot's order", "Anymal", in_robot_order),
    ("sign of a hip in the observation", "Anymal", hip),
    ("sign of a drive", "Anymal", drive_sign),
    ("drives swapped", "Anymal", drives_swapped),
    ("zero of an encoder", "Anymal", encoder_zero),
    ("dead encoder", "Anymal", encoder_dead),
    ("mounted IMU", "Anymal", mounted),
    ("gyroscope in degrees/s", "Anymal", fixed("gyro_in_degrees", obs("unit", GYRO, "degrees/s"))),
    ("gyroscope in the world's axes", "Anymal", fixed("gyro_of_world", obs("frame", GYRO, "world"))),
    ("velocity in the world's axes", "Anymal", fixed("speed_of_world", obs("frame", SPEED, "world"))),
    ("gravity in the world's axes", "Anymal", fixed("gravity_of_world", obs("frame", GRAVITY, "world"))),
    ("gravity by the inverse rotation", "Anymal", fixed("gravity_by_inverse", obs("frame", GRAVITY, "inverse"))),
    ("gravity points up", "Anymal", fixed("gravity_up", obs("sign", GRAVITY))),
    ("gravity in m/s^2", "Anymal", fixed("gravity_in_si", obs("unit", GRAVITY, "m/s^2"))),
    ("default pose not subtracted", "Anymal", fixed("pose_not_subtracted", obs("pose_missing", PLACES))),
    ("joints in degrees", "Anymal", fixed("joints_in_degrees", obs("unit", PLACES, "degrees"))),
    ("velocity scale left out", "Anymal", fixed("velocity_factor", obs("scale_missing", SPEEDS), amount=1.0)),
    ("velocity scale twice", "Anymal", fixed("velocity_factor", obs("scale_twice", SPEEDS), amount=0.0025)),
    ("velocities late", "Anymal", late("velocities_late", obs("delay", SPEEDS))),
    ("velocities filtered", "Anymal", amount("velocities_smoothed", 0.3, 0.6, obs("smooth", SPEEDS, "amount"))),
    ("observation late", "Anymal", late("observation_late", obs("delay", []))),
    ("observation refreshed every second step", "Anymal", fixed("observation_every", obs("held", [], 2.0), amount=2)),
    ("observations lost", "Anymal", amount("packets_lost", 0.2, 0.4, obs("stale", [], "amount"))),
    (
        "targets not scaled",
        "Anymal",
        fixed(
            "target_factors",
            obs("scale_missing", ["command_x", "command_y"]),
            obs("scale_missing", ["command_yaw"]),
            amount=(1.0, 1.0, 1.0),
        ),
    ),
    ("action not fed back", "Anymal", fixed("no_action_fed_back", obs("frozen", [f"{j}_action" for j in JOINTS], 0.0))),
    ("command fed back", "Anymal", fixed("command_fed_back", obs("command_fed_back", [f"{j}_action" for j in JOINTS]))),
    (
        "action of two steps ago fed back",
        "Anymal",
        fixed("action_of_two_steps", obs("delay", [f"{j}_action" for j in JOINTS], 1.0)),
    ),
    ("action scale", "Anymal", scales),
    ("default pose not added", "Anymal", fixed("pose_not_added", ("command", "pose_missing", JOINTS, None))),
    ("command late", "Anymal", late("command_late", ("command", "delay", [], None))),
    ("actions filtered", "Anymal", amount("smoothed", 0.3, 0.6, ("command", "smooth", [], "amount"))),
    ("control at 40 Hz", "Anymal", fixed("period", ("clock", "rate", [], 40.0), amount=1.25)),
    ("quaternion w x y z", "Quadcopter", fixed("quaternion_wxyz", obs("quaternion_order", QUATERNION, "wxyz"))),
    ("inverse quaternion", "Quadcopter", fixed("quaternion_inverse", obs("inverse", QUATERNION))),
    ("normaliser left out", "Quadcopter", fixed("normaliser_left_out", ("action", "normaliser_missing", [], None))),
    ("normalised twice", "Cartpole", fixed("normalised_twice", obs("normalised", []))),
    ("sampled actions", "Cartpole", amount("sampled", 0.1, 0.3, ("action", "noise", [], "amount"))),
    ("memory reset", "Pendulum", fixed("memory_reset", ("action", "memory_reset", [], None))),
    ("another policy", "Pendulum", fixed("other_policy", ("action", "other_policy", [], None))),
]
# more mistakes than the 40 of the count: for another seed's eyes (--more)
MORE: list[tuple[str, str, Plant]] = [
    ("rotors swapped", "Quadcopter", rotors_swapped),
    ("way to the target reversed", "Quadcopter", fixed("way_reversed", obs("sign", [f"to_target_{i}" for i in "xyz"]))),
    ("gyroscope in the body's axes", "Quadcopter", fixed("gyro_of_body", obs("frame", GYRO, "body"))),
    ("velocity in the body's axes", "Quadcopter", fixed("speed_of_body", obs("frame", SPEED, "body"))),
    ("turning not scaled", "Quadcopter", fixed("spin_not_scaled", obs("scale_missing", GYRO))),
    ("cart in mm", "Cartpole", fixed("cart_in_mm", obs("unit", ["cart_position"], "mm"))),
    ("pole in degrees/s", "Cartpole", fixed("pole_in_degrees", obs("unit", ["pole_velocity"], "degrees/s"))),
    ("cart's speed reversed", "Cartpole", fixed("cart_speed_reversed", obs("sign", ["cart_velocity"]))),
    (
        "angle and its rate swapped",
        "Cartpole",
        fixed(
            "angle_and_spin_swapped",
            obs("other_source", ["pole_angle"], "pole_velocity"),
            obs("other_source", ["pole_velocity"], "pole_angle"),
        ),
    ),
    ("sine and cosine swapped", "Pendulum", fixed("sine_and_cosine_swapped", obs("order", ["cos_theta", "sin_theta"]))),
    ("speed in rpm", "Pendulum", fixed("speed_in_rpm", obs("unit", ["theta_dot"], "rpm"))),
    (
        "actions limited",
        "Cartpole",
        amount("limited", 0.02, 0.04, ("action", "clip_smaller", ["slider_to_cart"], "amount")),
    ),
    (
        "actions without limit",
        "Cartpole",
        fixed("unlimited", ("action", "clip_missing", ["slider_to_cart"], None), amount=0.8),
    ),
    ("cables swapped", "Anymal", cables),
    ("motor mounted the other way round", "Anymal", motor),
    ("late steps", "Quadcopter", fixed("late_steps", ("clock", "late_steps", [], None), amount=0.2)),
]
RIGHT: list[tuple[str, str, dict[str, Any]]] = [
    ("exact", "Anymal", {}),
    ("noise of the sensors", "Anymal", {"noise": 0.003}),
    ("log of other sensors", "Anymal", {"noise": 0.002, "own_noise": 0.002}),
    ("poor sensors twice", "Anymal", {"noise": 0.01, "own_noise": 0.01}),
    ("4 rows per step", "Anymal", {"rows": 4}),
    ("4 rows per step with noise", "Anymal", {"rows": 4, "noise": 0.002, "own_noise": 0.001}),
    ("no state", "Anymal", {"drop": ("qpos", "qvel", "task")}),
    ("no velocities, no commands", "Anymal", {"drop": ("qvel", "ctrl"), "noise": 0.001}),
    ("no actions", "Anymal", {"drop": ("action",), "noise": 0.002}),
    ("four digits", "Anymal", {"digits": 4, "noise": 0.001}),
    ("short", "Anymal", {"episodes": 1, "seconds": 1.0, "noise": 0.002}),
    ("late steps now and then", "Anymal", {"jitter": 0.02}),
    ("exact", "Quadcopter", {}),
    ("noise of the sensors", "Quadcopter", {"noise": 0.003, "own_noise": 0.002}),
    ("2 rows per step", "Quadcopter", {"rows": 2, "noise": 0.001}),
    ("one short run", "Quadcopter", {"episodes": 1, "seconds": 0.8}),
    ("noise of the sensors", "Cartpole", {"noise": 0.002, "own_noise": 0.002}),
    ("clock 1 % off", "Cartpole", {"clock": 0.01, "digits": 5}),
    ("memory", "Pendulum", {"noise": 0.002}),
    ("memory, no state", "Pendulum", {"drop": ("qpos", "qvel"), "noise": 0.002}),
]

MORE_RIGHT: list[tuple[str, str, dict[str, Any]]] = [
    ("encoders of 4096 counts", "Anymal", {"grain": 2 * np.pi / 4096, "own_noise": 0.0005}),
    ("coarse encoders", "Anymal", {"grain": 2 * np.pi / 512}),
    ("state of half a step later", "Anymal", {"rows": 4, "state_rows_late": 2}),
    ("rows lost", "Anymal", {"lost": 0.02, "noise": 0.001}),
    ("every second step", "Anymal", {"every": 2}),
    ("flips of the quaternion", "Quadcopter", {"flips": True}),
    ("velocities in every fourth row", "Anymal", {"gaps": 4}),
    ("actions before their clip", "Anymal", {"unclipped_in_the_log": True}),
    ("offsets of 0.015 rad and rad/s", "Anymal", {"bias": 0.015, "noise": 0.001}),
    ("state and commands alone", "Anymal", {"drop": ("observation", "action")}),
    (
        "state and commands with noise",
        "Anymal",
        {"drop": ("observation", "action"), "noise": 0.002, "own_noise": 0.002},
    ),
    ("state and commands alone", "Cartpole", {"drop": ("observation", "action"), "own_noise": 0.001}),
]


def policies(folder: Path) -> dict[str, tuple[Any, Path, Path]]:
    """{task: (model, the policy's file, another policy's)}; untrained networks whose actions move."""
    import jax

    from bayessim_mjx.config import PPOConfig
    from bayessim_mjx.rl import export, networks, normalise, recurrent
    from bayessim_mjx.rl.networks import Policy

    found = {}
    for task in d.CODES:
        env = registry.make(task)
        size, memory = env.observation_size["policy"][0], 4 if task == "Pendulum" else 0
        config = PPOConfig(hidden_actor=(32, 32), hidden_critic=(8,), memory=memory)
        paths = []
        for seed in (0, 1):
            keys = jax.random.split(jax.random.PRNGKey(seed))
            params = networks.init(keys[0], networks.Sizes(size, size, env.action_size), config)
            actor = params["actor"]
            actor["layers"] = [*actor["layers"][:-1], jax.tree.map(lambda x: 40 * x, actor["layers"][-1])]
            samples = 0.2 + 0.6 * jax.random.normal(keys[1], (200, size))
            policy = Policy(actor, normalise.update(normalise.init(size), samples))
            own = recurrent.remembering(env, memory) if memory else env
            paths.append(folder / f"{task}_{seed}.onnx")
            export.write(paths[-1], policy, own)
        found[task] = (env.mj_model, *paths)
    return found


def named(result: Result, truth: Truth) -> bool:
    """Whether the findings are the planted ones and nothing else."""
    found = [(f.part, f.kind, set(f.entries), f.found) for f in result.findings]
    if len(found) != len(truth):
        return False
    return all(any(_same(f, t) for f in found) for t in truth)


def _same(found: tuple[str, str, set[str], Any], truth: tuple[str, str, list[str], Any]) -> bool:
    if found[:2] != truth[:2] or found[2] != set(truth[2]):
        return False
    if truth[3] is None or found[3] == truth[3]:
        return True
    numbers = isinstance(truth[3], float) and isinstance(found[3], float)
    if not numbers:
        return False
    slack = 0.06 if truth[1] == "stale" else 0.1 * abs(truth[3])  # what is lost is drawn: three sd of 400 steps
    return abs(found[3] - truth[3]) <= slack


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", default="")
    parser.add_argument("--more", action="store_true", help="further mistakes in place of the 40")
    parser.add_argument("--record", type=Path)
    parser.add_argument("--keep", type=Path)
    args = parser.parse_args()
    folder = args.keep or Path(tempfile.mkdtemp())
    folder.mkdir(parents=True, exist_ok=True)
    made, rows, begun = policies(folder), [], time.perf_counter()
    for k, (name, task, plant) in enumerate(MORE if args.more else MISTAKES):
        rng = np.random.default_rng([args.seed, k])
        wrong, truth = plant(rng)
        how = {"noise": float(rng.choice([0.0, 0.001, 0.003])), "own_noise": float(rng.choice([0.0, 0.001, 0.002]))}
        if args.only in name:
            rows.append(_case(folder / f"{k}", made[task], task, name, wrong, truth, how, 1000 * args.seed + k))
    for k, (name, task, how) in enumerate(MORE_RIGHT if args.more else RIGHT):
        if args.only in name:
            rows.append(
                _case(
                    folder / f"right_{k}", made[task], task, f"right: {name}", {}, [], how, 7000 + 1000 * args.seed + k
                )
            )
    planted, right = ([r for r in rows if bool(r["truth"]) is wrong] for wrong in (True, False))
    named_, accused = sum(r["named"] for r in planted), sum(not r["named"] for r in right)
    seconds = time.perf_counter() - begun
    print(f"named {named_} of {len(planted)}; accused {accused} of {len(right)}; {seconds:.0f} s")
    if args.record:
        args.record.write_text(json.dumps({"seed": args.seed, "rows": rows}, indent=1) + "\n")
    return 0


def _case(
    folder: Path, made: Any, task: str, name: str, wrong: dict, truth: Truth, how: dict, seed: int
) -> dict[str, Any]:
    model, right, other = made
    record(folder, task, model, other if "other_policy" in wrong else right, wrong, how, seed)
    result = check(right, folder)
    ok = named(result, truth)
    print(f"{'ok ' if ok else 'NO '} {task}: {name} {how}", flush=True)
    found = [[f.part, f.kind, list(f.entries), f.found] for f in result.findings]
    if not ok:
        print(f"     planted {truth}\n     found   {found}", flush=True)
    return {"task": task, "name": name, "truth": truth, "found": found, "named": ok}


if __name__ == "__main__":
    raise SystemExit(main())
