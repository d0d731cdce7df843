"""The benchmark's reality against hand computation, plain MuJoCo and the log reader."""

import functools
import re
from pathlib import Path

import blind
import cases
import isolable
import mujoco
import numpy as np
import pytest

from bayessim_mjx.blind.reality import lookalikes, strength
from bayessim_mjx.blind.reality import plant as truth
from bayessim_mjx.logs import read_logs

BENCHMARKS = Path(__file__).resolve().parents[2] / "benchmarks" / "diagnosis"
PENDULUM = cases.SYSTEMS["pendulum"]


@functools.cache
def pendulum_ruler() -> strength.Ruler:
    base = truth.base_parameters(PENDULUM, 0.2, np.random.default_rng(0))
    return strength.Ruler(PENDULUM, base, 0.2, 0)


def cause(name: str, size: float, system: str = "pendulum", where: str | None = None):
    robot = cases.SYSTEMS[system]
    plain = truth.Plant(robot, {})
    scales = truth.scales_of(plain, [robot.record(plain, 0, 0, noise=False)])
    place = where or cases.places(robot, name, scales)[0]
    return cases.CAUSES[name](place, scales, np.random.default_rng(0), size)


def coast(plant: truth.Plant, q: float, v: float, seconds: float, u: float = 0.0) -> tuple[float, float]:
    plant.reset(np.array([q]), np.array([v]), np.array([u]))
    for _ in range(round(seconds / plant.system.period)):
        plant.advance(np.array([u]))
    return tuple(float(x[0]) for x in plant.link())


def weightless(*causes, damping: float = 0.0) -> truth.Plant:
    plant = truth.Plant(PENDULUM, {"hinge.damping": damping}, causes)
    plant.model.opt.gravity[:] = 0
    return plant


def inertia(plant: truth.Plant) -> float:
    return 1 / float(plant.model.dof_invweight0[0])


def test_cases_of_a_seed_hide_what_they_hid_before_there_were_more_causes():
    drawn = blind.jobs(Path(), range(1000, 1004), ["single", "double"], ["pendulum"], ["medium", "strong"])
    assert [job[2] for job in drawn] == [
        ("sensor_filter",),
        ("armature", "actuator_bias"),
        ("coulomb_friction",),
        ("actuator_gain", "actuator_lag"),
        ("actuator_lag",),
        ("gravity_tilt", "actuator_bias"),
        ("rate_limit",),
        ("viscous_friction", "joint_offset"),
    ]


def test_nothing_of_the_library_is_used():
    truths = [
        BENCHMARKS / f"{name}.py" for name in ("cases", "drawn", "isolable", "score", "sysid", "systems", "tables")
    ]
    for file in (*Path(truth.__file__).parent.glob("*.py"), *truths):
        used = re.findall(r"^\s*(?:from|import) (bayessim_mjx[\w.]*|mujoco\.mjx|jax)", file.read_text(), re.MULTILINE)
        assert all(name.startswith("bayessim_mjx.blind") for name in used), file.name


def test_without_causes_and_noise_it_is_the_nominal_model_at_a_tenth_of_its_step(tmp_path):
    case = cases.make_case("two_link", (), "medium", 3, tmp_path, velocity=True, spread=0.0, noise=False)
    model = mujoco.MjModel.from_xml_path(str(case.out / "model.xml"))
    model.opt.timestep /= truth.FINER
    log = read_logs(case.out / "logs", model)[3]
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = log.qpos[0], log.qvel[0]
    for row in range(1, len(log)):
        data.ctrl[:] = log.ctrl[row - 1]
        mujoco.mj_step(model, data, nstep=round(0.01 / model.opt.timestep))
        np.testing.assert_allclose(log.qpos[row], data.qpos, atol=1e-6)


def test_dry_friction_takes_its_level_times_the_way_out_of_the_energy():
    level, v = 0.02, 4.0
    plant = weightless(cause("coulomb_friction", level))
    way, left = coast(plant, 0.0, v, 0.4)
    # 1/2 J v0^2 - 1/2 J v^2 = level way, but for the bristles' own bend
    assert 0.5 * inertia(plant) * (v**2 - left**2) == pytest.approx(level * way, rel=3e-3)


def test_a_resting_joint_sticks_below_the_level_and_slips_above_it():
    plant = weightless(cause("coulomb_friction", 0.1))
    assert abs(coast(plant, 0.0, 0.0, 1.0, u=0.09)[0]) < 1e-3
    # J w' = u - level
    way = 0.5 * (0.2 - 0.1) / inertia(plant)
    assert coast(plant, 0.0, 0.0, 1.0, u=0.2)[0] == pytest.approx(way, rel=5e-3)


def test_a_late_command_moves_late():
    plant = weightless(cause("actuator_delay", 0.05))
    plant.reset(np.zeros(1), np.zeros(1), np.zeros(1))
    for _ in range(10):
        plant.advance(np.ones(1))
    # J w' = 1 from 0.05 s on
    assert plant.link()[0][0] == pytest.approx(0.5 * 0.15**2 / inertia(plant), rel=1e-2)


def test_a_lag_loses_its_time_constant_of_impulse():
    plant = weightless(cause("actuator_lag", 0.02))
    plant.reset(np.zeros(1), np.zeros(1), np.zeros(1))
    for _ in range(25):
        plant.advance(np.ones(1))
    # integral of 1 - exp(-t / T) is t - T after many T
    assert plant.link()[1][0] == pytest.approx((0.5 - 0.02) / inertia(plant), rel=3e-3)


def test_a_limited_rate_loses_half_of_its_ramp():
    ramp = cause("rate_limit", 1.0)
    plant = weightless(ramp)
    ramp.size = ramp.limit * 0.02  # so that 1 is reached in 0.02 s
    plant.reset(np.zeros(1), np.zeros(1), np.zeros(1))
    for _ in range(5):
        plant.advance(np.ones(1))
    # had each step the command of its end, the impulse would be half a step (0.3 %) too large
    assert plant.link()[1][0] == pytest.approx((0.1 - 0.01) / inertia(plant), rel=1e-3)


def test_a_held_load_winds_up_an_elastic_joint_by_its_compliance():
    plant = truth.Plant(PENDULUM, {}, [cause("joint_elasticity", 0.05)])
    plant.model.dof_damping[:] = 1.0  # come to rest soon
    load = 0.6 * 9.81 * 0.2
    coast(plant, np.pi / 2, 0.0, 4.0, u=-load)
    rotor, play = plant.data.qpos
    torque = load * np.sin(rotor + play)  # about the hinge, on the link
    assert abs(play) == pytest.approx(0.05 * abs(torque), rel=0.02)


def test_the_link_moves_inside_the_play_and_no_farther():
    plant = truth.Plant(PENDULUM, {}, [cause("backlash", 0.04)])
    coast(plant, 0.5, 0.0, 3.0)
    low = high = 0.0
    for _ in range(100):
        plant.advance(np.zeros(1))
        low, high = min(low, plant.data.qpos[1]), max(high, plant.data.qpos[1])
    assert high - low < 0.045 and abs(plant.data.qpos[1]) <= 0.0225


@pytest.mark.slow
@pytest.mark.ci
@pytest.mark.parametrize("name", ["viscous_friction", "sensor_delay"])
def test_a_cause_of_the_asked_strength_is_that_far_from_the_model(name):
    ruler = pendulum_ruler()
    hidden = cause(name, 0.0)
    raw, left = strength.resize(hidden, ruler, 10.0)
    assert 8 < min(raw, strength.HIDDEN * left) < 12 and left <= raw
    assert ruler.measure(ruler.runs)[0] < 1e-9  # and without it nothing is


@pytest.mark.slow
@pytest.mark.ci
def test_two_writings_of_a_case_are_equal_and_other_seeds_differ(tmp_path):
    effects = [("external_force", "link"), "coulomb_friction"]
    first, second = (cases.make_case("pendulum", effects, "medium", 7, tmp_path / n) for n in "ab")
    other = cases.make_case("pendulum", (), "medium", 8, tmp_path / "c")
    files = sorted(p.relative_to(first.out) for p in first.out.rglob("*") if p.is_file())
    assert len(files) == 8 * 2 + 2
    assert all((first.out / f).read_bytes() == (second.out / f).read_bytes() for f in files)
    assert other.truth["base"] != first.truth["base"]


def test_logs_are_read_with_the_right_noise_and_conditions(tmp_path):
    case = cases.make_case("leg", (), "medium", 1, tmp_path, velocity=False)
    logs = read_logs(case.out / "logs", mujoco.MjModel.from_xml_path(str(case.out / "model.xml")))
    assert len({log.metadata["condition"] for log in logs}) >= 4 and len(logs) == 8
    noise = np.median([log.sigma_qpos for log in logs], axis=0)
    np.testing.assert_allclose(noise, cases.SYSTEMS["leg"].sigma, rtol=0.3)


@pytest.mark.slow
@pytest.mark.ci
def test_causes_are_drawn_again_from_the_truth_of_their_case(tmp_path):
    names = ["joint_spring", "viscous_friction"]
    told = cases.make_case("pendulum", names, "medium", 1_000_011, tmp_path).truth | {"kind": "double", "seed": 11}
    again, ruler = isolable.hidden(told)
    assert [c.name for c in again] == names and ruler.base == told["base"]
    for cause_again, own in zip(again, told["effects"], strict=True):
        assert cause_again.parameters() == own["parameters"]
    told["effects"][0]["parameters"]["rest"] += 0.1
    with pytest.raises(ValueError, match="another version"):
        isolable.hidden(told)


def test_of_two_causes_each_has_to_be_isolable():
    far, near = [{"left": 5.0}], [{"left": 0.3}]
    both = {"effects": [{"left": 9.0}, {"left": 9.0}]}
    assert isolable.each_isolable([far, far], both) and not isolable.each_isolable([far, near], both)
    assert isolable.each_isolable(far, {"effects": [{"left": 9.0}]})  # a single's, as older versions wrote it


def test_a_cause_in_its_own_place_leaves_nothing_and_others_leave_more():
    ruler = pendulum_ruler()
    scales = truth.scales_of(ruler.plain, ruler.runs)
    damper = cases.CAUSES["viscous_friction"]("hinge", scales, np.random.default_rng(0), 0.02)
    runs = lookalikes.record(damper, ruler)
    gap = ruler.windows(ruler.plain, runs)
    left = {
        name: lookalikes._closest(cases.CAUSES[name](where, scales, np.random.default_rng(1)), ruler, runs, gap)
        for name, where in (("viscous_friction", "hinge"), ("joint_spring", "hinge"), ("actuator_bias", "hinge_motor"))
    }
    whole = float(np.sqrt(np.mean(gap**2, axis=(0, 1))).max())
    assert left["viscous_friction"] < 0.1 * whole
    assert min(left["joint_spring"], left["actuator_bias"]) > 3 * left["viscous_friction"]


def test_friction_does_not_do_the_work_of_a_limit_that_acts_in_few_windows():
    ruler = pendulum_ruler()
    scales = truth.scales_of(ruler.plain, ruler.runs)
    limit = cases.CAUSES["actuator_saturation"]("hinge_motor", scales, np.random.default_rng(0))
    limit.size = 0.1
    acts = np.abs(ruler.windows(ruler.plain, lookalikes.record(limit, ruler))).max((1, 2)) > 1e-6
    assert 0 < acts.mean() < 0.5
    assert lookalikes.apart(limit, "coulomb_friction", "hinge", ruler) > lookalikes.APART
