"""The count of intervals on wrong data sheets and poor logs: what its cases are, and what its tables count."""

import argparse
import json
import os
import sys
from collections import Counter
from pathlib import Path

import count_intervals as command
import counted_cases as counted
import counted_tables as tables
import numpy as np
import pytest

from bayessim_mjx.blind.reality.plant import Plant, Run
from bayessim_mjx.blind.reality.system import RUNS


@pytest.fixture(scope="module")
def plans() -> list:
    return counted.plans()


def of(plans: list, logs: str, system: str) -> counted.Plan:
    return next(p for p in plans if p.logs == logs and p.system == system)


def test_there_are_as_many_cases_of_each_kind_as_was_said_beforehand(plans):
    assert len({p.name for p in plans}) == 420 and min(p.seed for p in plans) >= 9300
    plans = [p for p in plans if p.reality == "mujoco"]
    assert len(plans) == 300
    sheets = [p for p in plans if p.group == "sheets"]
    assert Counter((p.kind, p.system) for p in plans if p.group == "outside") == {
        (kind, system): n for kind, n in (("null", 10), ("unknown", 5)) for system in counted.SEEDS
    }
    assert Counter(p.logs for p in plans if p.logs != "all") == dict.fromkeys(counted.POOR, 10)
    assert Counter(p.kind for p in sheets) == {"single": 75, "double": 75}
    assert set(Counter(p.system for p in sheets).values()) == {20, 30}
    # log-uniform from 2 to 30 %: half of the cases lie below the geometric mean, 7.7 % (75 +- 6 of 150)
    assert 57 <= sum(p.scale < 0.0775 for p in sheets) <= 93
    assert all(0.02 <= p.scale <= 0.3 for p in sheets) and {p.scale for p in plans if p.logs != "all"} == {0.05}


def test_the_other_realities_have_sixty_cases_each_with_seeds_of_their_own(plans):
    assert {p.reality for p in plans} == set(command.REALITIES) == {"mujoco", *counted.OTHERS}
    for reality, first in counted.OTHERS.items():
        own = [p for p in plans if p.reality == reality]
        assert Counter((p.system, p.kind) for p in own) == {
            (system, kind): n for system in counted.SEEDS for kind, n in counted.EACH.items()
        }
        assert {p.seed for p in own} == {first, first + 1, first + 2} and len(own) == 60
        assert not {p.seed for p in own} & {p.seed for p in plans if p.reality != reality}
        assert {p.logs for p in own} == {"all"} and all(0.02 <= p.scale <= 0.3 for p in own)
    lawful = [p for p in plans if p.reality == "own laws" and p.kind in ("single", "double")]
    assert all(p.effects[0] in counted.own_laws.LAWS and len({*p.effects}) == len(p.effects) for p in lawful)
    assert {p.effects[0] for p in lawful} == {*counted.own_laws.LAWS}
    assert {p.reality for p in counted.frozen()} == {"mujoco"} and len(counted.frozen()) == 60


def test_a_case_has_the_causes_and_the_plant_of_its_reality(plans):
    own_plant = pytest.importorskip("own_plant")
    kinds = {}
    for reality in command.REALITIES:
        plan = counted.dataclasses.replace(plans[0], effects=("coulomb_friction",), reality=reality)
        case = counted.drawn(plan)
        case.causes[0].size = 0.1
        kinds[reality] = type(case.causes[0]).__name__, type(case.plant())
    assert kinds == {
        "mujoco": ("CoulombFriction", Plant),
        "own laws": ("OwnCoulomb", Plant),
        "own integrator": ("CoulombFriction", own_plant.OwnPlant),
    }


def test_parameter_errors_have_the_scale_of_their_case(plans):
    z, names = [], [f"p{i}" for i in range(20)]
    for i, plan in enumerate(p for p in plans if p.scale < 0.25):
        drawn = counted.errors(plan, names, np.random.default_rng(i))
        z += [(v - 1) / plan.scale for v in drawn.values()]
    assert np.mean(z) == pytest.approx(0.0, abs=0.06) and np.std(z) == pytest.approx(1.0, abs=0.05)
    wild = counted.errors(counted.dataclasses.replace(plans[0], scale=5.0), names, np.random.default_rng(0))
    assert min(wild.values()) == counted.LEAST


def runs(joints: int, rows: int = 101) -> list[Run]:
    """A ramp in every position and a count of rows in every velocity."""
    t = 0.01 * np.arange(rows)
    q, v = np.tile(0.0123 * t[:, None], joints), np.tile(np.arange(rows)[:, None] * 1.0, joints)
    one = {"time": t, "ctrl": q, "qpos": q, "qvel": v, "clean": q, "clean_v": v, "effort": q[0]}
    return [Run(**one, index=i) for i in range(len(RUNS))]


def test_what_stands_in_poor_logs(plans):
    rng, robot = np.random.default_rng(0), counted.SYSTEMS["two_link"]
    kept = {
        k: counted.logged(of(plans, k, "two_link"), robot, runs(2), rng)
        for k in ("one log", "two logs", "quantised", "late velocities", "position-only")
    }
    assert [len(kept[k]) for k in kept] == [1, 2, 8, 8, 8]
    assert len({RUNS[r.index][0] for r in kept["two logs"]}) == 2
    counts = kept["quantised"][0].qpos / (4 * np.array(robot.sigma))
    np.testing.assert_allclose(counts, np.round(counts), atol=1e-9)
    late = kept["late velocities"][0].qvel[:, 0]  # 20 ms are two rows of 10 ms
    np.testing.assert_array_equal(late[:5], [0, 0, 0, 1, 2])


@pytest.mark.parametrize("system", ["two_link", "leg", "arm_torque"])
def test_a_held_joint_shows_one_number_and_the_others_move(plans, system):
    plan = of(plans, "held joint", system)
    robot = counted.robot_of(plan)
    run = robot.record(Plant(robot, {}), 2, 0)
    (logged,) = counted.logged(plan, robot, [run], np.random.default_rng(0))
    travel = np.ptp(logged.qpos, axis=0)
    assert travel[robot.held] == 0 and np.delete(travel, robot.held).min() > 0.05
    assert np.ptp(run.clean[:, robot.held]) < counted.COUNT


def result(folder: Path, plan: counted.Plan, effects: list, closed: float | None, **parameters: dict) -> None:
    """What `one` writes of a pendulum whose link is 10 % too heavy, with viscous friction of 0.1."""
    hidden = {"name": "viscous_friction", "where": "hinge", "parameters": {"damping": 0.1}, "raw": 99.0, "left": 99.0}
    truth = {"system": "pendulum", "kind": plan.kind, "strength": plan.strength, "effects": [hidden], "velocity": True}
    said = {"verdict": "effects" if effects else "parameters", "effects": effects, "parameters": parameters}
    said["gap"] = {"closed": {"ci": [0.9, 0.99]} if effects else {}}
    told = {"truth": truth | {"base": {"link.mass": 1.1, "hinge.damping": 1.0}}, "said": said, "closed": closed}
    (folder / plan.name).mkdir()
    (folder / plan.name / "result.json").write_text(json.dumps(told | {"joints": {"hinge_motor": "hinge"}, "cpu": 50}))


def named(name: str, mean: float) -> dict:
    number = {"damping": {"mean": mean, "sd": 0.01, "bound": ""}}
    return {"name": name, "where": "hinge", "parameters": number, "equivalent_to": [{"effects": ["backlash@hinge"]}]}


def test_tables_count_what_holds_what_misses_and_what_did_not_end(plans, tmp_path):
    own = [p for p in plans if p.system == "pendulum" and p.kind == "single" and p.logs == "all"][:4]
    mass = {"link_mass_mult": {"mean": 1.0, "sd": 0.05, "nominal": 1.0}}  # 2 sd off
    result(tmp_path, own[0], [named("viscous_friction", 0.11)], 0.95, **mass)
    result(tmp_path, own[1], [named("viscous_friction", 0.2), named("armature", 1.0)], 0.8, **mass)
    result(tmp_path, own[2], [], None, hinge_damping_mult={"mean": 1.0, "sd": 0.05, "nominal": 1.0})
    (tmp_path / own[3].name).mkdir()
    (tmp_path / own[3].name / "output.txt").write_text("killed")
    found = {a.plan.name: a for a in tables.answers(tmp_path)}
    first, second, third, killed = (found[p.name] for p in own)
    assert first.rates == {
        "right": [True], "exact": [True], "inside": [True], "false names": [False],
        "strengths": [True], "known": [False], "closed": [True],
    }  # fmt: skip
    assert first.size == 2 and first.untold == ("known parameters not told",)
    assert second.rates["right"] == [True] and second.rates["exact"] == [False] == second.rates["strengths"]
    assert second.rates["false names"] == [True] and second.rates["known, other answers"] == [False]
    assert second.rates["closed"] == [False]
    assert third.rates["right"] == [False] and third.rates["known, other answers"] == [True]
    assert killed.state == "unfinished" and not killed.rates and len(found) == 420
    text = tables.tables(tmp_path)
    assert "| pendulum | 3 of 30 | 2 of 3" in text and "unfinished: 1" in text and "not begun: 416" in text
    assert "one alone: 0, 0" in tables.tables(tmp_path, tmp_path)


def test_each_reality_has_a_row_of_its_own(plans, tmp_path):
    one = {r: next(p for p in plans if p.reality == r and p.kind == "single") for r in command.REALITIES}
    unknown = next(p for p in plans if p.reality == "own laws" and p.kind == "unknown")
    result(tmp_path, one["mujoco"], [named("viscous_friction", 0.11)], 0.95)
    result(tmp_path, one["own laws"], [named("viscous_friction", 0.2)], 0.8)
    result(tmp_path, unknown, [named("backlash", 0.1)], None)
    text = tables.tables(tmp_path)
    by_logs, rows = text.split("Data sheets of any accuracy, by reality")
    assert "| all | 1 of 150 | 1 of 1" in by_logs and "| all | 2 of 222 | 2 of 2" in rows
    assert "| mujoco | 1 of 150 | 1 of 1" in rows and "| own laws | 1 of 36 | 1 of 1" in rows
    assert "| own integrator | 0 of 36 | - |" in rows
    assert "| own laws | - | 0 of 1, 0 % (0 to 79) | 1 of 1, 100 % (21 to 100) | 50 |" in rows


def test_tables_of_alarms_unknown_causes_and_stated_probabilities(plans, tmp_path):
    null, other = (next(p for p in plans if p.system == "pendulum" and p.kind == k) for k in ("null", "unknown"))
    single = next(p for p in plans if p.system == "pendulum" and p.kind == "single" and p.group == "sheets")
    result(tmp_path, null, [named("backlash", 0.1)], None)
    result(tmp_path, other, [], None)
    result(tmp_path, single, [named("viscous_friction", 0.11)], None)
    for plan, hidden, sets in (
        (null, False, [(["backlash@hinge"], 0.7), ([], 0.3)]),
        (other, True, []),
        (single, True, [(["viscous_friction@hinge"], 0.9), ([], 0.1)]),
    ):
        path = tmp_path / plan.name / "result.json"
        told = json.loads(path.read_text())
        told["truth"]["effects"] *= hidden
        told["said"]["evidence"] = [{"effects": e, "probability": p, "nats": 0.0} for e, p in sets]
        path.write_text(json.dumps(told))
    found = {a.plan.name: a for a in tables.answers(tmp_path)}
    assert found[null.name].rates["alarm"] == [True] and found[null.name].stated == (0.7, False)
    assert found[other.name].rates == {"unexplained": [False], "taken": [False]} and found[other.name].stated is None
    assert found[single.name].stated == (0.9, True)
    text = tables.tables(tmp_path)
    assert "| pendulum | 1 of 1, 100 % (21 to 100) | 0 of 1, 0 % (0 to 79) | 0 of 1, 0 % (0 to 79) | 50 |" in text
    assert "Brier score 0.250 of 2 answers" in text  # (.7^2 + .1^2) / 2


def test_errors_belong_to_the_nearest_scale_by_ratio():
    assert [tables.nearest(s) for s in (0.03, 0.033, 0.07, 0.072, 0.24, 0.25)] == [0.02, 0.05, 0.05, 0.1, 0.2, 0.3]


def test_cases_that_run_when_the_time_is_over_are_killed_and_begun_again(tmp_path, monkeypatch, capsys):
    def sleep(folder: Path, args: argparse.Namespace) -> list[str]:
        assert args.more == "--accuracy 5%"
        return ["sh", "-c", "echo begun; exec sleep 60"]

    monkeypatch.setattr(command, "_words", sleep)
    given = {"workers": 1, "minutes": 0.1, "only": "sheets", "systems": "leg", "shard": "1/10", "reality": "mujoco"}
    args = argparse.Namespace(
        out=tmp_path, more="--accuracy 5%", does="run", case="", cluster="", platforms="cpu", **given
    )
    for _ in range(2):
        command.run(args)
    assert [p.read_text() for p in tmp_path.glob("*/output.txt")] == ["begun\n"]
    assert capsys.readouterr().out.count("1 killed, 1 not begun") == 2
    first = sorted(tmp_path.iterdir())[0]
    (first / "result.json").write_text("{}")
    command.run(args)
    assert "1 cases" in capsys.readouterr().out and os.path.exists(first / "plan.json")


def test_one_case_is_examined_by_its_name_without_a_result_and_only_once(plans, tmp_path, monkeypatch, capsys):
    begun: list = []

    def write(folder: Path, args: argparse.Namespace) -> list[str]:
        begun.append(folder.name)
        return ["sh", "-c", f"echo [] > {folder}/isolable.json"]

    monkeypatch.setattr(command, "_words", write)
    name = next(p.name for p in plans if p.reality == "own integrator")
    for _ in range(2):
        monkeypatch.setattr(sys, "argv", ["count_intervals.py", "isolable", str(tmp_path), "--case", name])
        command.main()
    assert begun == [name] and "0 cases" in capsys.readouterr().out


def test_sizes_are_those_of_the_written_case_where_there_is_one(plans, tmp_path, monkeypatch):
    given: list = []
    monkeypatch.setattr(counted, "rivals_of", lambda plan, truth: given.append((plan.name, truth)) or [])
    folder = tmp_path / plans[0].name
    folder.mkdir()
    (folder / "plan.json").write_text(json.dumps(counted.dataclasses.asdict(plans[0])))
    command.rivals(folder)
    (folder / "result.json").write_text(json.dumps({"truth": {"effects": [1]}}))
    command.rivals(folder)
    assert given == [(plans[0].name, None), (plans[0].name, {"effects": [1]})]
    assert (folder / "isolable.json").read_text() == "[]"


def test_a_case_is_isolable_if_neither_known_parameters_nor_another_cause_do_the_work():
    far, near = {"name": "joint_spring", "where": "hinge", "left": 5.0}, {"name": "cogging", "where": "m", "left": 0.4}
    assert counted.each_isolable([{"left": 6.0, "rivals": [far]}])
    assert not counted.each_isolable([{"left": 6.0, "rivals": [near, far]}])
    assert not counted.each_isolable([{"left": 0.5, "rivals": [far]}])  # known parameters do it
    assert not counted.each_isolable([{"left": 6.0, "rivals": [far]}, {"left": 0.5, "rivals": [far]}])


@pytest.mark.slow
@pytest.mark.ci
def test_viscous_friction_is_damping_and_never_isolable(plans):
    plan = next(p for p in plans if p.name == "pendulum_single_s9308")
    assert plan.effects == ("viscous_friction",)
    case = counted.drawn(plan)
    case.causes[0].size = 0.015
    told = {"effects": [{"size": 0.015}]}
    (found,) = counted.rivals_of(plan, told)
    assert found["left"] < counted.APART and not counted.each_isolable([found])
