"""Robots without a fixed base, and logs of them by plain MuJoCo: a drone, an underwater vehicle, a wheeled robot.

Written apart from the library: the motion is MuJoCo's (C) at a tenth of the model's timestep, with noise, under a
controller at the logs' rate; causes act on commands and by `xfrc_applied`. Of each case: model.xml (nominal), logs/ and
truth.json.

    python benchmarks/diagnosis/free_bodies.py drone drag_strong /tmp/case
"""

import argparse
import dataclasses
import json
from collections.abc import Callable
from pathlib import Path

import mujoco
import numpy as np
from free_robots import DRONE, VEHICLE, WHEELED, dive, drive, fly

FINER = 10  # steps of the reality in one of the model's
# Of a motion capture system and an inertial unit (data sheets of Vicon and of MEMS gyroscopes): m, rad, m/s, rad/s
NOISE = {"place": 5e-4, "turn": 1e-3, "speed": 5e-3, "rate": 5e-3, "wheel": 1e-3, "wheel_rate": 5e-3}
SPREAD = 0.03  # standard deviation of the truth's masses about the model's, a share

Array = np.ndarray


@dataclasses.dataclass
class Cause:
    """Something that the model lacks. Every hook changes the truth alone.

    Attributes:
        truth: (effect, where, {parameter: value}) as the library should name it; effect "" where it knows none.
        edit: changes the specification; command: `[nu]` -> `[nu]` in each fine step of `dt` s; push: `[6]`, force and
            moment (world) at the centre of mass of the first moving body, of (model, data).
    """

    truth: tuple[str, str, dict[str, float]]
    edit: Callable[[mujoco.MjSpec], None] = lambda spec: None
    command: Callable[[Array, float], Array] = lambda u, dt: u
    push: Callable[[mujoco.MjModel, mujoco.MjData], Array] = lambda model, data: np.zeros(6)


def drag(where: str, linear: float = 0.0, quadratic: float = 0.0, wind: tuple = (0.0, 0.0, 0.0)) -> Cause:
    """Drag of air or water at the centre of mass, in still air or in a steady wind (m/s)."""
    blown = np.array(wind)

    def push(model: mujoco.MjModel, data: mujoco.MjData) -> Array:
        v = _velocity(model, data) - blown
        return np.concatenate([-(linear + quadratic * np.linalg.norm(v)) * v, np.zeros(3)])

    numbers = {"linear": linear, "quadratic": quadratic}
    if blown.any():
        return Cause(("wind", where, numbers | dict(zip(("x", "y", "z"), wind, strict=True))), push=push)
    return Cause(("body_drag", where, numbers), push=push)


def uneven(where: str, linear: float, side: float, up: float) -> Cause:
    """Drag that differs by the body's axes."""

    def push(model: mujoco.MjModel, data: mujoco.MjData) -> Array:
        frame = data.xmat[1].reshape(3, 3)
        along = linear * np.array([1, side, up]) * (frame.T @ _velocity(model, data))
        return np.concatenate([-frame @ along, np.zeros(3)])

    return Cause(("directional_drag", where, {"linear": linear, "side": side, "up": up}), push=push)


def steady(where: str, force: tuple[float, float, float]) -> Cause:
    """Push with a constant force (N, world)."""
    numbers = dict(zip(("force_x", "force_y", "force_z"), force, strict=True))
    return Cause(("external_force", where, numbers), push=lambda m, d: np.array([*force, 0, 0, 0]))


def gain(where: str, index: int, factor: float) -> Cause:
    def command(u: Array, dt: float) -> Array:
        return np.where(np.arange(len(u)) == index, factor * u, u)

    return Cause(("actuator_gain", where, {"gain": factor}), command=command)


def lag(time: float) -> Cause:
    """Let all rotors follow their commands by a first-order lag, exact for a held command."""
    state: list[Array] = []

    def command(u: Array, dt: float) -> Array:
        if not state or len(state[0]) != len(u):
            state[:] = [u.copy()]
        state[0] = u + (state[0] - u) * np.exp(-dt / time)
        return state[0]

    cause = Cause(("actuator_lag", "all", {"time_constant": time}), command=command)
    cause.restart = state.clear  # type: ignore[attr-defined]
    return cause


def load(body: str, mass: float, place: tuple[float, float, float]) -> Cause:
    """Fix a point mass to a body."""

    def edit(spec: mujoco.MjSpec) -> None:
        extra = spec.body(body).add_body(name="extra", pos=place, ipos=(0, 0, 0))  # else ipos is pos, once more
        extra.explicitinertial, extra.mass, extra.inertia = True, mass, np.full(3, 1e-9)

    numbers = dict(zip(("com_x", "com_y", "com_z"), place, strict=True))
    return Cause(("payload", body, {"mass": mass} | numbers), edit=edit)


def slung(body: str, mass: float, length: float) -> Cause:
    """Hang a load on a string, whose swing nothing measures."""

    def edit(spec: mujoco.MjSpec) -> None:
        extra = spec.body(body).add_body(name="slung", pos=(0, 0, -0.02))
        extra.add_joint(type=mujoco.mjtJoint.mjJNT_BALL, damping=[1e-4, 0, 0])
        extra.explicitinertial, extra.mass, extra.inertia = True, mass, np.full(3, 1e-5)
        extra.ipos = (0, 0, -length)

    return Cause(("", body, {"mass": mass, "length": length}), edit=edit)


def tether(body: str, stiffness: float, slack: float) -> Cause:
    """Pull on the vehicle by a cable beyond its slack, from where it began."""

    def push(model: mujoco.MjModel, data: mujoco.MjData) -> Array:
        away = data.xipos[1] - np.array([0.3, 0.2, -2.0])
        far = float(np.linalg.norm(away))
        pull = -stiffness * max(far - slack, 0.0) * away / max(far, 1e-9)
        return np.concatenate([pull, np.zeros(3)])

    return Cause(("", body, {"stiffness": stiffness, "slack": slack}), push=push)


def patch(body: str, level: float) -> Cause:
    """Slow the robot by a carpet on every second strip of the floor, .4 m wide."""

    def push(model: mujoco.MjModel, data: mujoco.MjData) -> Array:
        v = _velocity(model, data) * np.array([1, 1, 0])
        on = np.sin(2 * np.pi * data.xipos[1][0] / 0.8) > 0
        return np.concatenate([-level * on * v / np.hypot(np.linalg.norm(v), 0.01), np.zeros(3)])

    return Cause(("", body, {"level": level}), push=push)


def tyre(name: str, factor: float) -> Cause:
    """Change the sliding friction of one tyre."""

    def edit(spec: mujoco.MjSpec) -> None:
        spec.geom(name).friction[0] *= factor

    return Cause(("contact_friction", name, {"scale": factor}), edit=edit)


def rubbing(joint: str, level: float) -> Cause:
    """Add dry friction (rolling resistance) at a wheel."""

    def edit(spec: mujoco.MjSpec) -> None:
        spec.joint(joint).frictionloss = level

    return Cause(("coulomb_friction", joint, {"level": level}), edit=edit)


def _velocity(model: mujoco.MjModel, data: mujoco.MjData) -> Array:
    """m/s, of the first moving body's centre of mass, in the world."""
    out = np.zeros(6)
    mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_BODY, 1, out, 0)
    return out[3:]


@dataclasses.dataclass(frozen=True)
class Robot:
    """A robot, how it is flown or driven, and its cases.

    Attributes:
        xml: of the nominal model; period: s between rows; seconds: of each log.
        fly: (qpos, qvel, time, run, random wobble `[nu]`) -> commands `[nu]`, from the measured state.
        cases: {name: causes}; "null": none.
    """

    name: str
    xml: str
    period: float
    seconds: float
    fly: Callable[[Array, Array, float, int], Array]
    cases: dict[str, Callable[[], list[Cause]]]
    runs: int = 5


ROBOTS = {
    "drone": Robot(
        "drone", DRONE, 0.01, 4.0, fly,
        {
            "null": lambda: [],
            "drag_weak": lambda: [drag("drone", linear=0.1)],
            "drag_strong": lambda: [drag("drone", linear=0.4)],
            "square_weak": lambda: [drag("drone", quadratic=0.05)],
            "square_strong": lambda: [drag("drone", quadratic=0.25)],
            "uneven_weak": lambda: [uneven("drone", 0.1, 1.0, 3.0)],
            "uneven_strong": lambda: [uneven("drone", 0.3, 0.5, 2.0)],
            "wind_weak": lambda: [drag("drone", linear=0.25, wind=(1.5, -1.0, 0.0))],
            "wind_strong": lambda: [drag("drone", linear=0.4, wind=(4.0, 2.0, 0.0))],
            "force": lambda: [steady("drone", (0.3, -0.2, 0.0))],
            "gain_weak": lambda: [gain("front_right", 1, 0.93)],
            "gain_strong": lambda: [gain("front_right", 1, 0.8)],
            "lag_weak": lambda: [lag(0.02)],
            "lag_strong": lambda: [lag(0.06)],
            "load": lambda: [load("drone", 0.1, (0.05, 0.02, -0.03))],
            "unknown": lambda: [slung("drone", 0.1, 0.25)],
        },
    ),
    "vehicle": Robot(
        "vehicle", VEHICLE, 0.02, 4.0, dive,
        {
            "null": lambda: [],
            "drag_weak": lambda: [drag("hull", linear=5.0)],
            "drag_strong": lambda: [drag("hull", linear=20.0)],
            "square_weak": lambda: [drag("hull", quadratic=10.0)],
            "square_strong": lambda: [drag("hull", quadratic=40.0)],
            "uneven_strong": lambda: [uneven("hull", 10.0, 2.0, 3.0)],
            "wind_weak": lambda: [drag("hull", quadratic=40.0, wind=(0.2, 0.1, 0.0))],
            "wind_strong": lambda: [drag("hull", quadratic=40.0, wind=(0.5, -0.3, 0.0))],
            "gain_weak": lambda: [gain("back_left", 2, 0.9)],
            "gain_strong": lambda: [gain("back_left", 2, 0.7)],
            "lag_weak": lambda: [lag(0.04)],
            "lag_strong": lambda: [lag(0.12)],
            "unknown": lambda: [tether("hull", 60.0, 0.25)],
        },
    ),
    "wheeled": Robot(
        "wheeled", WHEELED, 0.01, 4.0, drive,
        {
            "null": lambda: [],
            "slip_weak": lambda: [tyre("left_tyre", 0.5)],
            "slip_strong": lambda: [tyre("left_tyre", 0.3)],
            "rolling_weak": lambda: [rubbing("left_wheel", 0.03)],
            "rolling_strong": lambda: [rubbing("left_wheel", 0.1)],
            "gain_weak": lambda: [gain("right_motor", 1, 0.9)],
            "gain_strong": lambda: [gain("right_motor", 1, 0.75)],
            "load": lambda: [load("chassis", 1.0, (-0.05, 0.05, 0.1))],
            "drag_strong": lambda: [drag("chassis", linear=3.0)],
            "unknown": lambda: [patch("chassis", 2.5)],
        },
    ),
}  # fmt: skip


def record(robot: Robot, causes: list[Cause], seed: int) -> list[dict[str, Array]]:
    """Return a table for each run: time, commands, measured positions and velocities of the nominal model's joints."""
    rng = np.random.default_rng((seed, *robot.name.encode()))
    spec = mujoco.MjSpec.from_string(robot.xml)
    for cause in causes:
        cause.edit(spec)
    model, nominal = spec.compile(), mujoco.MjModel.from_xml_string(robot.xml)
    for body in range(1, nominal.nbody):
        factor = np.exp(SPREAD * rng.standard_normal())
        model.body_mass[body] *= factor
        model.body_inertia[body] *= factor
    mujoco.mj_setConst(model, mujoco.MjData(model))
    model.opt.timestep = nominal.opt.timestep / FINER
    return [_run(robot, model, nominal, causes, run, rng) for run in range(robot.runs)]


def _run(
    robot: Robot,
    model: mujoco.MjModel,
    nominal: mujoco.MjModel,
    causes: list[Cause],
    run: int,
    rng: np.random.Generator,
) -> dict[str, Array]:
    data, dt = mujoco.MjData(model), model.opt.timestep
    nq, nv, steps = nominal.nq, nominal.nv, round(robot.period / dt)
    for cause in causes:
        getattr(cause, "restart", lambda: None)()
    for _ in range(round(1.0 / robot.period)):  # a second before the log begins: no state is at rest
        _advance(robot, model, data, causes, run, steps, nominal)
    rows: dict[str, list[Array]] = {"time": [], "ctrl": [], "qpos": [], "qvel": []}
    for _ in range(round(robot.seconds / robot.period)):
        rows["time"].append(np.array(data.time))
        qpos, qvel = _measured(nominal, data.qpos[:nq], data.qvel[:nv], rng)
        u = _advance(robot, model, data, causes, run, steps, nominal)
        for name, value in (("ctrl", u), ("qpos", qpos), ("qvel", qvel)):
            rows[name].append(value)
    out = {name: np.array(value) for name, value in rows.items()}
    return out | {"time": out["time"] - out["time"][0]}


def _advance(
    robot: Robot,
    model: mujoco.MjModel,
    data: mujoco.MjData,
    causes: list[Cause],
    run: int,
    steps: int,
    nominal: mujoco.MjModel,
) -> Array:
    """Return the command that was held over one row of the log."""
    command = robot.fly(data.qpos[: nominal.nq], data.qvel[: nominal.nv], data.time, run)
    for _ in range(steps):
        u = command
        mujoco.mj_forward(model, data)
        data.xfrc_applied[:] = 0
        for cause in causes:
            u = cause.command(u, model.opt.timestep)
            data.xfrc_applied[1] += cause.push(model, data)
        data.ctrl[:] = u
        mujoco.mj_step(model, data)
    return command


def _measured(model: mujoco.MjModel, qpos: Array, qvel: Array, rng: np.random.Generator) -> tuple[Array, Array]:
    """Return the state with the sensors' noise; orientations stay unit quaternions."""
    n, more = NOISE, model.nv - 6
    step = rng.standard_normal(model.nv) * np.array([*[n["place"]] * 3, *[n["turn"]] * 3, *[n["wheel"]] * more])
    shown = qpos.copy()
    mujoco.mj_integratePos(model, shown, step, 1.0)
    speed = np.array([*[n["speed"]] * 3, *[n["rate"]] * 3, *[n["wheel_rate"]] * more])
    return shown, qvel + speed * rng.standard_normal(model.nv)


def write(name: str, case: str, out: str | Path, seed: int = 0, speeds: bool = True) -> dict:
    """Write a case: model.xml, logs/ (without velocities if not `speeds`) and truth.json; returns the truth."""
    robot, out = ROBOTS[name], Path(out)
    causes = robot.cases[case]()
    model = mujoco.MjModel.from_xml_string(robot.xml)
    joints = [(model.joint(j).name, 7 if model.jnt_type[j] == 0 else 1) for j in range(model.njnt)]
    many = lambda kind, less: [  # noqa: E731
        f"{kind}:{j}" + (f"[{k}]" if w > 1 else "") for j, w in joints for k in range(w - (less if w > 1 else 0))
    ]
    header = ["time", *(f"ctrl:{model.actuator(i).name}" for i in range(model.nu)), *many("qpos", 0)]
    header += many("qvel", 1) if speeds else []
    (out / "logs").mkdir(parents=True, exist_ok=True)
    (out / "model.xml").write_text(robot.xml)
    for run, table in enumerate(record(robot, causes, seed)):
        columns = [table["time"][:, None], table["ctrl"], table["qpos"]]
        rows = np.concatenate([*columns, table["qvel"]] if speeds else columns, 1)
        path = out / "logs" / f"run{run}.csv"
        np.savetxt(path, rows, fmt="%.9g", delimiter=",", header=",".join(header), comments="")
    truth = {"robot": name, "case": case, "seed": seed, "effects": [cause.truth for cause in causes]}
    (out / "truth.json").write_text(json.dumps(truth, indent=1))
    return truth


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("robot", choices=list(ROBOTS))
    parser.add_argument("case")
    parser.add_argument("out")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--pose", action="store_true", help="log no velocities, as motion capture does")
    parser.add_argument("--runs", type=int, default=5)
    parser.add_argument("--seconds", type=float, default=4.0)
    asked = parser.parse_args()
    ROBOTS[asked.robot] = dataclasses.replace(ROBOTS[asked.robot], runs=asked.runs, seconds=asked.seconds)
    print(write(asked.robot, asked.case, asked.out, asked.seed, not asked.pose))
