"""The time step's own error: known for a pushed mass, mended where motion is fast, the floor of logs without noise.

Logs come from MuJoCo C: by Runge-Kutta at a tenth of the step (the continuous truth), or by the very same step.
"""

import dataclasses
import itertools
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest

from bayessim_mjx.diagnosis import setup
from bayessim_mjx.diagnosis.fitting import discretisation, integrator_choice, robot
from bayessim_mjx.diagnosis.fitting.cutting import windows_of
from bayessim_mjx.diagnosis.fitting.delivered import Delivered
from bayessim_mjx.diagnosis.fitting.quadratic import eliminate
from bayessim_mjx.diagnosis.fitting.substep_errors import Errors
from bayessim_mjx.diagnosis.logcheck.noise import noise_free
from bayessim_mjx.diagnosis.phrases import time_step
from bayessim_mjx.diagnosis.setup import _measured
from bayessim_mjx.logs import Channels, Log, estimate_velocity
from bayessim_mjx.parameters import Parameter, ParameterSpace
from bayessim_mjx.physics import native

pytestmark = [pytest.mark.slow, pytest.mark.ci]  # whole diagnoses and fits

STEP, PERIOD, NOISE = 0.005, 0.01, 3e-4  # s, s, rad
MASS = """<mujoco><option timestep=".005" gravity="0 0 0"/><worldbody><body><joint name="rail" type="slide"/>
<geom size=".1" mass="2" contype="0" conaffinity="0"/></body></worldbody>
<actuator><motor joint="rail"/></actuator></mujoco>"""
ARM = """<mujoco><option timestep=".005" integrator="implicitfast"/>
<default><geom type="capsule" contype="0" conaffinity="0"/></default>
<worldbody><body><joint name="shoulder" axis="0 1 0" damping=".06" armature=".02"/>
<geom fromto="0 0 0 0 0 -.3" size=".025" mass="1"/><body pos="0 0 -.3">
<joint name="elbow" axis="0 1 0" damping=".03" armature=".01"/><geom fromto="0 0 0 0 0 -.25" size=".02" mass=".6"/>
</body></body></worldbody><actuator><motor joint="shoulder"/><motor joint="elbow"/></actuator></mujoco>"""


def the(xml: str) -> robot.Robot:
    model = mujoco.MjModel.from_xml_string(xml)
    return robot.Robot(model, lambda: mujoco.MjSpec.from_string(xml), None, robot.default_space(model), "it")


def logs(xml: str, command, finer: int = 10, noise: float = NOISE, count: int = 4, rows: int = 160) -> list[Log]:
    """command: (log, time, qpos, qvel) -> ctrl, held for PERIOD."""
    spec = mujoco.MjSpec.from_string(xml)
    spec.option.timestep = STEP / finer
    if finer > 1:
        spec.option.integrator = mujoco.mjtIntegrator.mjINT_RK4
    model, rng = spec.compile(), np.random.default_rng(0)
    channels, sigma = Channels.of(model), np.full(model.nq, max(noise, 1e-7))
    out = []
    for i in range(count):
        data, table = mujoco.MjData(model), []
        for k in range(rows):
            data.ctrl[:] = command(i, k * PERIOD, data.qpos, data.qvel)
            table.append((data.ctrl.copy(), data.qpos + noise * rng.normal(size=model.nq)))
            mujoco.mj_step(model, data, round(PERIOD / model.opt.timestep))
        ctrl, qpos = (np.array(c) for c in zip(*table, strict=True))
        time = PERIOD * np.arange(rows)
        qvel, spread = estimate_velocity(time, qpos, channels, sigma)
        out.append(Log(f"log{i}", time, ctrl, qpos, qvel, False, channels, sigma, spread))
    return out


def push(i, time, qpos, qvel):
    return 3.0


def swing(i, time, qpos, qvel):
    rate = 2 * np.pi * (0.5 + 0.1 * i)
    target = np.array([0.9 * np.sin(rate * time), 0.8 * np.sin(1.3 * rate * time + i)])
    return np.array([40.0, 14.0]) * (target - qpos) - np.array([3.0, 1.0]) * qvel


def measured(own, recorded):
    """(discretisation, rms of measured minus simulated positions by factor, start states fitted)."""
    physics = own.physics(PERIOD)
    cuts = windows_of(physics, recorded, None, False)
    found = discretisation.measure(physics, cuts, recorded, 4)
    errors = Errors(physics, cuts(1), 4)
    columns, spread, nv = errors.columns(found.sigma), cuts(1).spread, physics.mj_model.nv

    def left(factor):
        offsets = np.zeros((len(columns), len(spread)))
        for _ in range(4):
            error = errors.run(cuts(factor), factor, offsets=offsets)
            r = (error / found.sigma).reshape(len(error), -1)
            nothing = np.zeros((*r.shape, 0))
            offsets = offsets + eliminate(r, nothing, columns, offsets, spread)[1].step(nothing, np.zeros(0))
        error = errors.run(cuts(factor), factor, offsets=offsets)[..., :nv]
        return np.sqrt(np.mean(error**2, (0, 1)))

    return found, {f: left(f) for f in (1, 2, 4)}


RUBS = ARM.replace("<joint", '<joint frictionloss=".4"')


@pytest.mark.parametrize("xml", [RUBS, ARM.replace('damping=".06"', 'damping=".06 .3 .2"')])
def test_finer_steps_have_the_models_own_forces(xml):
    """Dry friction without the solver, and polynomial damping: without them the motion is another one."""
    recorded = logs(xml, swing)
    own = dataclasses.replace(the(xml), rubbing=native.rubbing(the(xml).mj_model))
    there, gone = (measured(which, recorded)[1][4].max() for which in (own, the(ARM)))
    assert there < 2.5 * NOISE < 0.2 * gone


def test_a_pushed_mass_is_ahead_by_half_a_step():
    found, _ = measured(the(MASS), logs(MASS, push))
    # x_n = a h^2 n (n + 1) / 2 against a t^2 / 2: ahead by a h t / 2, as if it had started faster
    since = PERIOD * np.arange(1, 51)
    assert found.own[0] == pytest.approx(3.0 / 2.0 * STEP / 2 * np.sqrt(np.mean(since**2)), rel=0.02)
    assert found.settled[0] < 0.02 * found.own[0]
    assert found.factor == 1 and found.floor[0] == pytest.approx(found.sigma[0], rel=0.01)


def test_fast_motion_is_simulated_more_finely_until_the_step_does_not_show():
    found, left = measured(the(ARM), logs(ARM, swing))
    assert found.factor > 1 and not found.simulated.any()
    assert (left[1] / NOISE).max() > 1.3  # would be explained by some effect
    assert (left[found.factor] / found.floor[:2]).max() < 1.2
    true = np.sqrt(np.maximum(left[1] ** 2 - NOISE**2, 0.0))  # the time step's part, told beforehand within a third
    told = found.left * found.factor
    assert told[:2].max() == pytest.approx(true.max(), rel=0.35)
    (text,) = time_step.costs(found)
    assert (
        "time step of 5 ms" in text
        and "noise standard deviations" in text
        and any(n in text for n in ("shoulder", "elbow"))
    )
    fine = found.robot(the(ARM)).physics(PERIOD)
    assert fine.substeps == 2 * found.factor and fine.dt == pytest.approx(PERIOD)
    assert found.to_dict()["substep"] == pytest.approx(STEP / found.factor)


@pytest.mark.slow
def test_the_integrator_that_is_recommended_leaves_nothing():
    """RK4 at the same step: commands act when they are sent, and velocities are those of the positions' time."""
    found, left = measured(the(ARM.replace("implicitfast", "RK4")), logs(ARM, swing))
    assert found.factor == 1 and (found.own[:2] / NOISE).max() < 0.1 and not time_step.costs(found)
    assert (left[1] / NOISE).max() < 1.05  # nothing but the sensors' noise


@pytest.mark.parametrize("finer", [1, 10])
def test_without_noise_the_step_itself_is_the_floor(finer):
    found, left = measured(the(ARM), logs(ARM, swing, finer, noise=0.0))
    assert found.simulated.all()
    assert (left[min(found.factor, 4)] / found.floor[:2]).max() < 1.2
    assert (left[1] / found.sigma[:2]).max() > 10  # a huge gap, were the floor the sensors' alone
    assert "show no noise" in time_step.costs(found)[0]


def test_noise_is_seen_whatever_the_motion():
    def log(qpos):
        time, channels = 0.02 * np.arange(len(qpos)), Channels.of(mujoco.MjModel.from_xml_string(MASS))
        zero = np.zeros((len(qpos), 1))
        return Log("a", time, zero, qpos[:, None], zero, False, channels, np.ones(1), np.ones(1))

    smooth = np.sin(9 * 0.02 * np.arange(300)) + 0.3 * np.sin(17 * 0.02 * np.arange(300))
    rng = np.random.default_rng(0)
    assert noise_free([log(smooth)], 0)
    assert not noise_free([log(smooth + 1e-3 * rng.normal(size=300))], 0)
    assert not noise_free([log(np.round(smooth, 3))], 0)


def test_the_coarsest_that_is_fine_enough_is_chosen():
    assert discretisation._choose({1: 0.4, 2: 0.2}) == 1
    assert discretisation._choose({1: 1.1, 2: 0.55, 4: 0.2}) == 2
    assert discretisation._choose({1: 9.0, 2: 5.0, 4: 2.0}) == 4  # what can be had
    assert discretisation._choose({1: 9.0, 2: 8.0, 4: 7.0}) == 1  # chaos: nothing gained


def test_where_nothing_touches_there_are_no_contacts():
    ball = MASS.replace('contype="0" conaffinity="0"', "").replace("<body>", '<geom type="plane" size="1 1 1"/><body>')
    assert robot.contacts(the(ball).physics(PERIOD))
    assert not robot.contacts(the(ARM).physics(PERIOD))


@pytest.mark.parametrize(("touching", "steps"), [(True, 25), (False, 50)])
def test_windows_get_shorter_where_contacts_make_the_step_worth_many_noises(monkeypatch, touching: bool, steps: int):
    """The step's worth grows with the window, 8.3 noises after 50 steps; without contacts finer steps mend it."""

    def worth(physics, cuts, logs, most, **more):
        floor = np.full(2, cuts(1).steps / 6)
        return SimpleNamespace(floor=floor, lottery=floor[0] > 1 / discretisation.BELIEVED)

    monkeypatch.setattr(discretisation, "measure", worth)
    monkeypatch.setattr(setup, "contacts", lambda physics: touching)
    pushed = logs(MASS, lambda i, t, q, v: np.sin(3 * t + i))
    cuts, step = _measured(the(MASS).physics(PERIOD), pushed, None, False, None)
    assert cuts(1).steps == steps and step.floor[0] == steps / 6


@pytest.mark.parametrize(
    ("floor", "simulated", "share"), [(1e-3, False, 1.0), (2e-3, False, 0.5), (2e-2, False, 0.2), (2e-2, True, 1.0)]
)
def test_how_much_of_the_noise_is_the_sensors(floor, simulated, share):
    """At least .2; logs of a simulation have no noise of their own to compare with."""
    sigma, none = np.full(4, 1e-3), np.zeros(4)
    found = discretisation.Discretisation(
        0.01, 1, 1.0, none, none, none, sigma, np.full(4, floor), np.full(2, simulated), ("a", "b")
    )
    assert found.believed == pytest.approx(share)
    assert found.lottery == (floor > 1e-2)


def test_what_is_left_beyond_the_tolerance_is_told():
    none, sigma = np.zeros(4), np.full(4, 1e-3)
    left = np.array([1e-3, 8e-3, 0.0, 0.0])
    given = (0.01, 8, 1.0, none, none, left, sigma, sigma, np.zeros(2, bool), ("a", "b"))
    (text,) = time_step.beyond(discretisation.Discretisation(*given, limit=np.full(2, 2e-3)))
    assert "sub-steps of 1.2 ms still change the motion by 0.008 rad or m at b, where 0.002 may stay" in text
    assert not time_step.beyond(discretisation.Discretisation(*given, limit=np.full(2, 1e-2)))
    assert not time_step.beyond(discretisation.Discretisation(*given))


def chosen(recorded, limit, *left, xml=ARM):
    """How a robot is simulated, and the integrators that were tried."""
    tried = []

    def measured_by(own, **rest):
        tried.append(int(own.mj_model.opt.integrator))
        return _measured(own, recorded, None, False, np.full(own.mj_model.nv, limit), **rest)

    return integrator_choice.choose(the(xml), PERIOD, recorded, measured_by, *left), tried


@pytest.mark.parametrize("noise", [0.05, NOISE])
def test_where_nothing_touches_the_integrator_is_runge_and_kuttas(noise):
    """A tolerance of a fiftieth of the noise: 3e-6 rad of a swing of two radians."""
    found, tried = chosen(logs(ARM, swing, noise=noise), 0.02 * noise)
    assert tried == [mujoco.mjtIntegrator.mjINT_RK4] == [found.robot.mj_model.opt.integrator]
    assert not time_step.sentences(found)[0]
    assert found.worth.believed > 0.9


def test_the_error_is_that_of_the_delivered_integrator_where_the_diagnosis_has_another():
    """A pushed mass: Euler is ahead by a h t / 2, and RK4, by which it is simulated, is exact."""
    found, _ = chosen(logs(MASS, push), 1.0, xml=MASS)
    assert (found.worth.integrator, found.worth.delivered.integrator) == ("RK4", "Euler")
    since = PERIOD * np.arange(1, 51)
    assert found.worth.own[0] == pytest.approx(3.0 / 2.0 * STEP / 2 * np.sqrt(np.mean(since**2)), rel=0.002)
    assert (found.worth.left[:1] / found.worth.sigma[:1]).max() < 0.01
    (text,) = time_step.sentences(found)[1]
    assert "time step of 5 ms (Euler) costs" in text and "The diagnosis simulates by RK4 at 5 ms, which leaves" in text


SERVO = ARM.replace("<motor", '<position kp="9" kv=".4"')


def rested(xml, integrator, timestep, command):
    """Angles of a servoed arm that begins at rest, in plain MuJoCo."""
    spec = mujoco.MjSpec.from_string(xml)
    spec.option.integrator, spec.option.timestep = integrator, timestep
    model = spec.compile()
    data, angles = mujoco.MjData(model), []
    for ctrl in command:
        data.ctrl[:] = ctrl
        mujoco.mj_step(model, data, round(PERIOD / timestep))
        angles.append(data.qpos.copy())
    return np.array(angles)


def test_the_error_of_a_servos_step_is_that_which_plain_mujoco_has():
    """From rest, so that the start is known: implicitfast at 5 ms beside RK4 at .1 ms."""
    recorded = logs(SERVO, lambda i, t, q, v: 0.5 * np.sin(np.array([3.0, 4.0]) * t + i))
    model = the(SERVO).mj_model
    cut = windows_of(the(SERVO).physics(PERIOD), recorded, None, False)(1)
    around, at = cut.batch.around, cut.batch.around.start
    offsets = -np.concatenate([np.asarray(around.qpos)[:, at], np.asarray(around.qvel)[:, at]], 1)
    found = Delivered(model, PERIOD).step_error(cut, offsets, 4)
    for w in (0, len(cut) - 1):
        rows = cut.logs[cut.log[w]].ctrl[cut.start[w] : cut.start[w] + cut.steps]
        coarse = rested(SERVO, model.opt.integrator, STEP, rows)
        fine = rested(SERVO, mujoco.mjtIntegrator.mjINT_RK4, 1e-4, rows)
        np.testing.assert_allclose(found[w, :, :2], fine - coarse, atol=0.002 * np.abs(fine - coarse).max())


@pytest.mark.parametrize("change", ["law", "off"])
def test_commands_through_a_loop_or_a_drive_that_is_off_are_not_plain_mujocos(change):
    (log,) = logs(SERVO, lambda i, t, q, v: np.full(2, 0.1), count=1, rows=20)
    metadata = {"controller": {"law": "position", "kp": 1.0}} if change == "law" else {}
    streams = {"enabled:a": np.zeros(20)} if change == "off" else {}
    given = Delivered(the(ARM).mj_model, PERIOD)
    named = dataclasses.replace(log, metadata=metadata, streams=streams)
    space = the(ARM).space
    assert given.plays([log], space) and not given.plays([log, named], space)


@pytest.mark.parametrize(
    ("operation", "own", "other"), [("scaling", 1.0, 1.2), ("additive", 0.0, 0.1), ("absolute", 0.03, 0.06)]
)
def test_parameters_whose_nominal_values_are_not_the_models_are_not_plain_mujocos(operation, own, other):
    given = Delivered(the(ARM).mj_model, PERIOD)
    for nominal in (own, other):
        known = Parameter(
            "d", nominal, 0.0, 2.0, operation=operation, attribute="damping", target="elbow", kind="joint"
        )
        assert given.plays([], ParameterSpace([known])) == (nominal == own)


def test_where_time_is_limited_the_integrator_stays_unless_a_search_by_the_better_one_fits():
    found, tried = chosen(logs(ARM, swing, noise=1e-5), 0.05, 1e-6)
    assert tried == [mujoco.mjtIntegrator.mjINT_RK4, mujoco.mjtIntegrator.mjINT_IMPLICITFAST]
    assert found.robot.mj_model.opt.integrator == mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    assert integrator_choice.TOO_LONG in time_step.sentences(found)[0]


def test_logs_of_a_simulation_keep_its_integrator():
    """Without noise nobody knows whether their step was this one."""
    found, _ = chosen(logs(ARM, swing, finer=1, noise=0.0), 0.05)
    assert found.robot.mj_model.opt.integrator == mujoco.mjtIntegrator.mjINT_IMPLICITFAST


def test_errors_of_when_something_touches_add_up_as_squares_do():
    """A velocity that jumps by 1 at a random time, on grids of h and h/2 and so on; the root mean square in 1 s."""
    rng, steps = np.random.default_rng(0), [2.0**-k for k in range(3, 16)]
    at = rng.uniform(0.2, 0.8, 4000)
    late = [np.ceil(at / h) * h for h in steps]  # each grid jumps at its first point behind the true time
    between = [np.sqrt(np.mean(np.abs(a - b))) for a, b in itertools.pairwise(late)]
    gain, error = between[0] / between[1], np.sqrt(np.mean(late[0] - at))
    np.testing.assert_allclose(gain, 2**0.5, rtol=0.05)
    np.testing.assert_allclose(between[0] * discretisation._all(gain, touching=True), error, rtol=0.05)
    assert between[0] * discretisation._all(gain, touching=False) > 2 * error


def test_errors_of_a_smooth_motion_add_up_one_to_one():
    """x(h) = 1 + h: halving changes h / 2, all halvings h."""
    np.testing.assert_allclose(discretisation._all(2.0, touching=False) * 0.5, 1.0)
