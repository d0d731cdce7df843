"""Motion by equations that are not MuJoCo's: accelerations, energy, and the motion that MuJoCo's fine steps tend to."""

import jax
import mujoco
import numpy as np
import own_motion as motion
import own_robot
import pytest
from own_plant import OwnPlant
from systems import SYSTEMS

from bayessim_mjx.blind.reality.menu import CAUSES, places
from bayessim_mjx.blind.reality.plant import Plant, scales_of

SIX = [s for s in SYSTEMS if s != "foot"]


def every_law(spec: mujoco.MjSpec) -> mujoco.MjModel:
    """A model with springs, drag, a filter, a tilted gravity, a load, a stop far away, and a joint behind another."""
    rng = np.random.default_rng(5)
    for joint in spec.joints:
        joint.stiffness, joint.damping = rng.uniform(0, 3, 3), rng.uniform(0, 0.2, 3)
        joint.springref = rng.normal()
    first, last = spec.joints[0], spec.bodies[-1]
    first.parent.add_joint(name="behind", type=first.type, axis=[0.6, 0.0, 0.8], pos=[0.1, 0.2, 0.3], armature=0.01)
    load = last.add_body(name="load", pos=[0.1, 0.02, 0.03], quat=[0.8, 0.6, 0, 0])
    load.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, size=[0.01, 0.02, 0.03], mass=0.4, contype=0, conaffinity=0)
    spec.option.gravity = [1.0, -2.0, -9.0]
    motor = spec.actuators[0]
    motor.dyntype, motor.dynprm[0] = mujoco.mjtDyn.mjDYN_FILTEREXACT, 0.03
    motor.forcelimited, motor.forcerange = True, [-0.5, 0.4]
    return spec.compile()


@pytest.mark.parametrize("system", SIX)
def test_accelerations_are_mujocos(system):
    model = every_law(SYSTEMS[system].spec())
    data, bot, rng = mujoco.MjData(model), own_robot.robot(model), np.random.default_rng(0)
    given = motion.Given(
        ctrl=rng.normal(size=model.nu), gain=model.actuator_gainprm[:, 0], bias=model.actuator_biasprm[:, :3],
        low=model.actuator_forcerange[:, 0], high=model.actuator_forcerange[:, 1], force=rng.normal(size=model.nv),
        push=rng.normal(size=(len(bot.bodies), 6)),
    )  # fmt: skip
    with jax.enable_x64(True):
        found = jax.jit(lambda q, v, act: motion.change(bot, q, v, act, given))
        for _ in range(5):
            q, v, act = rng.normal(size=model.nv), 3 * rng.normal(size=model.nv), rng.normal(size=model.nu)
            data.qpos[:], data.qvel[:], data.act[:] = q, v, act[:1]
            data.ctrl[:], data.qfrc_applied[:], data.xfrc_applied[bot.bodies] = given.ctrl, given.force, given.push
            mujoco.mj_forward(model, data)
            gained, rate, (effort, drive, bias) = found(q, v, act)
            np.testing.assert_allclose(gained, data.qacc, rtol=1e-9, atol=1e-9)
            np.testing.assert_allclose(effort, data.actuator_force, rtol=1e-9, atol=1e-9)
            np.testing.assert_allclose(drive, data.qfrc_actuator, rtol=1e-9, atol=1e-9)
            np.testing.assert_allclose(bias, data.qfrc_bias, rtol=1e-9, atol=1e-9)
            np.testing.assert_allclose(rate[:1], data.act_dot, rtol=1e-9)


@pytest.mark.parametrize("system", SIX)
def test_energy_stays_where_nothing_takes_it(system):
    spec = SYSTEMS[system].spec()
    spec.option.enableflags |= int(mujoco.mjtEnableBit.mjENBL_ENERGY)
    for joint in spec.joints:
        joint.damping = np.zeros(3)
        joint.stiffness[0] = 1.0
    for actuator in spec.actuators:
        actuator.gainprm, actuator.biasprm = np.zeros(10), np.zeros(10)
    model = spec.compile()
    data, rng = mujoco.MjData(model), np.random.default_rng(1)
    bot = own_robot.robot(model)
    state = np.concatenate([rng.normal(size=2 * model.nv), np.zeros(model.nu)])
    still = np.zeros(7 * model.nu + model.nv + 6 * len(bot.bodies))
    energy = []
    for _ in range(5):
        data.qpos[:], data.qvel[:] = state[: model.nv], state[model.nv : 2 * model.nv]
        mujoco.mj_forward(model, data)
        energy.append(data.energy.copy())
        with jax.enable_x64(True):
            state = np.asarray(motion.program(bot)(state, still, 1e-4, 2500))[: len(state)]
    kinetic, total = np.array(energy)[:, 1], np.array(energy).sum(1)
    assert np.ptp(kinetic) > 0.1 * np.abs(total).max()  # energy goes to and fro
    np.testing.assert_allclose(total, total[0], rtol=0, atol=1e-9 * np.ptp(kinetic))


def caused(system: str, name: str, share: float):
    """A robot and a cause at the first of its places, of a share of its largest size."""
    robot = SYSTEMS[system]
    plain = Plant(robot, {})
    scales = scales_of(plain, [robot.record(plain, 2, 0, noise=False)])
    cause = CAUSES[name](places(robot, name, scales)[0], scales, np.random.default_rng(0))
    cause.size = share * cause.largest
    return robot, cause


@pytest.mark.parametrize(
    ("system", "name"),
    [
        ("arm_servo", "payload"),
        ("leg", "actuator_lag"),
        ("cartpole", "joint_elasticity"),
        ("two_link", "speed_torque_limit"),
    ],
)
def test_runs_are_those_that_mujocos_steps_tend_to(system, name):
    """MuJoCo's error falls with its step: a tenth of the step, a tenth of the difference."""
    robot, cause = caused(system, name, 0.2)
    own, command = OwnPlant(robot, {}, [cause]), np.full(len(robot.spec().actuators), 0.5)
    start = np.zeros(len(own.joints)) + 0.3

    def moved(plant: Plant) -> np.ndarray:
        plant.reset(start, 0 * start, command)
        out = []
        for k in range(30):
            plant.advance(command * (-1) ** (k // 10))
            out.append(plant.measure()[0])
        return np.array(out)

    mine, off = moved(own), []
    for finer in (1, 10):
        plant = Plant(robot, {}, [cause])
        plant.steps *= finer
        plant.timestep = plant.model.opt.timestep = plant.timestep / finer
        off.append(np.abs(moved(plant) - mine).max())
    assert off[0] < 0.01 * np.ptp(mine) and off[1] < 0.2 * off[0]


def test_a_link_stays_within_its_gap_and_reaches_both_flanks():
    """A stop gives way by no more than a spring that takes up the link's speed beside the motor's force."""
    robot, cause = caused("pendulum", "backlash", 0.5)
    own = OwnPlant(robot, {}, [cause])
    play, bot = own.model.joint("hinge/play"), own.robot
    own.reset(np.array([0.5]), np.zeros(1), np.zeros(1))
    seen, speeds = [], []
    for k in range(200):
        own.advance(np.array([2.0 if k % 50 < 25 else -2.0]), 20)
        seen.append(own.data.qpos[play.qposadr[0]])
        speeds.append(own.data.qvel[play.dofadr[0]])
    half, soft = cause.size / 2, np.abs(speeds).max() / own_robot.STOP + 2 * 2.0 / bot.stop[play.dofadr[0]]
    assert soft < 0.2 * half
    assert half < max(seen) < half + soft and -half > min(seen) > -half - soft


def test_what_is_not_written_down_is_refused():
    with pytest.raises(ValueError, match="contacts"):
        OwnPlant(SYSTEMS["foot"], {})
