"""The closed-loop study: a true diagnosis predicts the surrogate's returns exactly, a wrong one does not."""

import dataclasses
import json

import jax
import numpy as np
import pytest

from bayessim_mjx import gap_loop, registry, rl
from bayessim_mjx.closed_loop import judge, measures, words
from bayessim_mjx.diagnosis import correction
from bayessim_mjx.diagnosis.fitting.robot import of_task
from bayessim_mjx.diagnosis.summary import files
from bayessim_mjx.monitor.writer import event_files, records
from bayessim_mjx.parameters import Parameter, ParameterSpace
from bayessim_mjx.physics import Drive, control_step, controllers
from tests.diagnosis.handwritten import diagnosis

TRUTH = [("actuator_gain", "torque", {"gain": (0.6, 0.03)}), ("coulomb_friction", "hinge", {"level": (0.3, 0.02)})]
WRONG = [("actuator_gain", "torque", {"gain": (1.4, 0.03)})]
SMALL = ["--iterations=8", "--episodes=16", "env.episodeLength=40", "ppo.num_envs=8", "ppo.num_steps=4"]
SMALL += ["ppo.num_epochs=1", "ppo.num_minibatches=1", "ppo.hidden_actor=[8]", "ppo.hidden_critic=[8]"]
SMALL += ["--headless", "--device=cpu"]
MASS = {"pendulum_mass_mult": (1.1, 0.01)}


@pytest.fixture(autouse=True, scope="module")
def cache(tmp_path_factory):
    """The commands of this file share what they compile."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("BAYESSIM_MJX_CACHE", str(tmp_path_factory.mktemp("cache")))
        yield
    jax.config.update("jax_compilation_cache_dir", None)


@pytest.fixture(scope="module")
def robot():
    return of_task(registry.make("Pendulum"))


@pytest.fixture(scope="module")
def folder(tmp_path_factory, robot):
    """`truth` and `wrong` diagnoses, as `diagnose` writes them."""
    root = tmp_path_factory.mktemp("found")
    for name, found, known in (("truth", TRUTH, MASS), ("wrong", WRONG, {})):
        made = diagnosis(found, known)
        made.save(root / name)
        files.write_outputs(made, robot, root / name)
    return root


@pytest.fixture
def trained(monkeypatch):
    """Training without training: each mark has other random weights; what was asked for is noted."""
    done = []

    def train(env, ppo, key, domain, at, keep, progress=None):
        done.append((len(env.space), domain is not None))
        shape = jax.eval_shape(lambda key: rl.policy_of(rl.init(env, ppo, key)), key)
        ones, rng = jax.tree.map(lambda x: np.ones(x.shape, x.dtype), shape), np.random.default_rng(0)
        for mark in at:
            actor = jax.tree.map(lambda x: rng.normal(size=x.shape).astype(x.dtype), ones.actor)
            keep(mark, dataclasses.replace(ones, actor=actor))

    monkeypatch.setattr(judge, "train", train)
    return done


def command(folder, name, out, *more):
    surrogate = [] if "--real" in more else ["--surrogate", str(folder / "truth" / "effects.yaml")]
    given = ["--task", "Pendulum", "--diagnosis", str(folder / name), *surrogate, "--out", str(out)]
    return gap_loop.main([*given, *more, *SMALL])


def read(out):
    return json.loads((out / "gap_loop.json").read_text())


@pytest.mark.slow
@pytest.mark.ci
def test_true_and_wrong_diagnoses_and_a_second_start(folder, tmp_path, trained, capsys):
    out = tmp_path / "out"
    assert command(folder, "truth", out) == 0
    # nominal: the known mass; corrected and real: mass, gain, friction; drawn from a prior: corrected and wide
    assert trained == [(1, False), (3, True), (1, True), (3, False)]
    found = read(out)
    assert set(found) >= {
        "schema",
        "task",
        "policies",
        "gap",
        "ranking",
        "recovery",
        "effects",
        "sentences",
        "versions",
    }
    for policies in found["policies"].values():
        (returns,) = (p["returns"] for p in policies)
        assert returns["corrected"] == returns["real"]  # the same numbers drawn: equal, not merely alike
        assert returns["nominal"] != returns["real"]
    assert found["gap"]["training"]["after"] == 0.0
    assert found["gap"]["training"]["before"] > 3 and found["gap"]["training"]["closure"] == 1.0
    assert found["ranking"]["tau"]["corrected"] == 1.0 and found["ranking"]["violation"]["corrected"] == 0.0
    gain, friction = found["effects"]
    assert (gain["effect"], gain["where"], friction["effect"]) == ("actuator_gain", "torque", "coulomb_friction")
    alone, last = (friction["change"]["nominal"][k]["mean"] for k in ("alone", "last"))
    assert alone != last and not friction["irrelevant"]
    tags = {v.tag for _, e in records(event_files(out)[0]) if e.HasField("summary") for v in e.summary.value}
    assert {"Gap/before", "Gap/after", "Return_real/nominal"} <= tags
    assert "trained on the corrected simulator" in capsys.readouterr().out

    trained.clear()
    (out / "policies" / "wide_0" / "000008" / "index.json").unlink()  # killed while it was written
    assert command(folder, "truth", out) == 0
    assert trained == [(1, True)]  # only that one again
    again = read(out)
    assert again["policies"] == found["policies"] and again["gap"] == found["gap"]

    trained.clear()
    assert command(folder, "wrong", out) == 0
    # pi_0 and the oracle do not depend on the diagnosis; nor does the wide one
    assert trained == [(1, True)]
    wrong = read(out)["gap"]["training"]
    assert wrong["before"] == pytest.approx(found["gap"]["training"]["before"])
    assert wrong["after"] > wrong["before"] / 2  # the gain goes the wrong way


@pytest.mark.slow
@pytest.mark.ci
def test_logs_only(folder, tmp_path, trained, robot, capsys):
    """Without a surrogate: predictions, and the logs' own controller replayed."""
    law = {"controller": {"law": "position", "kp": 8.0, "kd": 1.0}}
    physics = correction.apply(diagnosis(TRUTH, MASS), robot.physics(robot.control_dt))
    gains = controllers.read(law, physics.mj_model, ("torque",), "test")
    step = jax.jit(lambda w, c: control_step(physics, w, c, Drive(law=gains))[0])
    world, rows = physics.world(physics.space.nominal), []
    for k in range(81):
        target = 0.8 * np.sin(0.1 * k)
        rows.append((0.05 * k, target, float(world.qpos[0]), float(world.qvel[0])))
        world = step(world, np.array([target], np.float32))
    np.savetxt(tmp_path / "run.csv", rows, delimiter=",", header="time,ctrl:torque,qpos:hinge,qvel:hinge", comments="")
    (tmp_path / "run.yaml").write_text("controller: {law: position, kp: 8.0, kd: 1.0}\n")
    out = tmp_path / "out"
    assert command(folder, "truth", out, "--real", str(tmp_path / "run.csv")) == 0
    found = read(out)
    assert found["gap"] is found["recovery"] is None and set(found["policies"]) == {"nominal", "corrected"}
    error = found["replay"]["error"]["hinge"]
    assert error["corrected"] < 0.3 * error["nominal"]
    assert "controller in closed loop" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"--diagnosis": "nowhere"}, ["--diagnosis nowhere", "no diagnosis.json"]),
        ({"--diagnosis": None}, ["--diagnosis is missing"]),
        ({"--surrogate": None}, ["--surrogate", "--real"]),
        ({"--surrogate": "nowhere.yaml"}, ["--surrogate nowhere.yaml", "no such file"]),
        ({"--seeds": "0"}, ["--seeds 0", "at least 1"]),
        ({"--timestep": "1"}, ["--timestep 1", "at most the task's own"]),
        ({"--surrogate_timestep": "0"}, ["--surrogate_timestep 0", "positive"]),
        ({"--task": "Cartpole"}, ["--diagnosis", "--task Cartpole", "no actuator 'torque'"]),
        ({"--task": "Pendulm"}, ["Did you mean Pendulum"]),
        ({"effects=[{effect: coulomb_friction, where: hinge}]": ""}, ["effects", "--diagnosis"]),
    ],
)
def test_bad_input_is_one_line(folder, change, words, capsys):
    plain = {"--task": "Pendulum", "--diagnosis": str(folder / "truth")}
    plain |= {"--surrogate": str(folder / "truth" / "effects.yaml")}
    argv = [part for flag, value in (plain | change).items() if value is not None for part in (flag, value) if part]
    assert gap_loop.main(argv) == 2
    error = capsys.readouterr().err
    assert error.startswith("error: ") and error.count("\n") == 1
    assert all(word in error for word in words), error


@pytest.mark.parametrize("written", ["diagnosis.json alone", "effects.yaml"])
def test_an_effect_on_a_joint_that_the_task_has_not(folder, tmp_path, written, robot, capsys):
    wrong = diagnosis([("coulomb_friction", "elbow", {"level": (0.3, 0.02)})])
    wrong.save(tmp_path)
    if written == "effects.yaml":
        text = (folder / "truth" / "effects.yaml").read_text().replace("where: hinge", "where: elbow")
        (tmp_path / "effects.yaml").write_text(text)
    assert command(tmp_path.parent, tmp_path.name, tmp_path / "out", "--real", "x.csv") == 2
    error = capsys.readouterr().err
    assert "Pendulum" in error and "no joint 'elbow'" in error
    assert not (tmp_path / "out").exists()


def test_a_diagnosis_without_findings_is_refused(tmp_path, capsys):
    diagnosis([]).save(tmp_path)
    assert command(tmp_path.parent, tmp_path.name, tmp_path / "out", "--real", "x.csv") == 2
    assert "nothing to correct" in capsys.readouterr().err
    (tmp_path / "diagnosis.json").write_text("{}")
    assert command(tmp_path.parent, tmp_path.name, tmp_path / "out", "--real", "x.csv") == 2
    assert "damaged diagnosis.json" in capsys.readouterr().err


def pair(nominal, corrected, real, n=10):
    wobble = np.linspace(-1, 1, n)
    return {s: m + wobble for s, m in (("nominal", nominal), ("corrected", corrected), ("real", real))}


def test_gap_of_the_return():
    found = measures.gap([pair(10.0, 5.0, 4.0), pair(8.0, 5.0, 6.0)])
    assert (found["before"], found["after"]) == pytest.approx((4.0, 1.0))
    assert found["closure"] == pytest.approx(0.75)
    assert measures.gap([pair(4.0, 4.0, 4.0)])["closure"] is None  # nothing to close


def test_ranking():
    policies = [pair(3, 1, 10), pair(2, 2, 20), pair(1, 3, 30)]
    found = measures.ranking(policies)
    assert found["tau"] == {"nominal": -1.0, "corrected": 1.0}
    # every policy is misplaced against others: by 20, 10 and 20 at most
    assert found["violation"] == {"nominal": pytest.approx(50 / 3), "corrected": 0.0}
    assert measures.ranking(policies[:2])["tau"]["nominal"] is None


def test_return_recovered():
    rng = np.random.default_rng(0)
    means = {"nominal": 0.0, "corrected": 8.0, "wide": 3.0, "oracle": 10.0}
    real = {role: m + 0.1 * rng.normal(size=(5, 50)) for role, m in means.items()}
    found = measures.recovery(real)
    assert found["corrected"]["recovered"] == pytest.approx(0.8, abs=0.02)
    assert found["wide"]["recovered"] == pytest.approx(0.3, abs=0.02)
    low, high = found["corrected"]["ci"]
    assert low < found["corrected"]["recovered"] < high < low + 0.05
    alike = {role: rng.normal(size=(1, 50)) for role in means}
    alike["oracle"] = alike["nominal"][:, ::-1] + 0.01  # the same returns in other episodes
    assert measures.recovery(alike)["corrected"] == {"recovered": None, "ci": None}


def test_what_is_recovered_has_no_interval_under_five_seeds():
    """Trainings differ by 1, episodes by .01: nothing that few seeds know the spread of."""
    rng = np.random.default_rng(1)
    means = {"nominal": 0.0, "corrected": 8.0, "wide": 3.0, "oracle": 10.0}
    for seeds, told in ((1, "1 seed: no interval"), (4, "4 seeds: no interval"), (5, "90 % interval")):
        seen = lambda m: m + rng.normal(size=(seeds, 1)) + 0.01 * rng.normal(size=(seeds, 50))  # noqa: E731, B023
        drawn = {role: seen(m) for role, m in means.items()}
        drawn["nominal"] = drawn["nominal"][:1]  # a policy that was given
        found = measures.recovery(drawn)
        assert found["seeds"] == seeds and (found["corrected"]["ci"] is None) is (seeds < 5)
        assert told in words._recovery(found)


@pytest.mark.slow
def test_intervals_of_what_is_recovered_cover_it():
    """Trainings differ by a tenth of what is lost; share .8; 90 % of 2000 intervals, standard error .7 %."""
    rng = np.random.default_rng(2)
    means = {"nominal": 0.0, "corrected": 8.0, "wide": 3.0, "oracle": 10.0}
    inside = []
    for _ in range(2000):
        episodes = 0.3 * rng.normal(size=16)
        real = {r: m + rng.normal(size=(5, 1)) + episodes + 0.1 * rng.normal(size=(5, 16)) for r, m in means.items()}
        low, high = measures.recovery(real)["corrected"]["ci"]
        inside.append(low < 0.8 < high)
    assert 0.88 < np.mean(inside) < 0.93


def test_which_effects_matter():
    little, much = {"mean": 0.2, "se": 0.01}, {"mean": -3.0, "se": 0.01}
    backlash, friction = ({"effect": n, "where": "hinge", "last": little} for n in ("backlash", "coulomb_friction"))
    found = measures.relevance(
        [backlash | {"alone": little}, friction | {"alone": much}],  # hidden behind the others, but not alone
        [backlash | {"alone": little}, friction | {"alone": little}],
        cost=10.0,
    )
    assert [e["irrelevant"] for e in found] == [True, False]
    assert found[1]["change"]["nominal"] == {"last": little, "alone": much}


def test_wide_ranges_marks_and_effects_switched_off(robot):
    space = judge.wide(robot.space + ParameterSpace([Parameter("extra", 0.0, 0.0, 0.3)]))
    assert [(p.low, p.high, p.prior) for p in space.parameters] == [(0.5, 1.5, "uniform"), (0.0, 0.3, "uniform")]
    assert judge.marks(80) == [0, 10, 20, 30, 40, 50, 60, 70, 80] and judge.marks(2) == [0, 1, 2]
    physics = correction.apply(diagnosis(TRUTH, MASS), robot.physics(robot.control_dt))
    np.testing.assert_allclose(physics.neutral, [1.1, 1.0, 0.0], rtol=1e-6)
    own = judge.places(physics)
    assert {k: v.tolist() for k, v in own.items()} == {
        ("actuator_gain", "torque"): [False, True, False],
        ("coulomb_friction", "hinge"): [False, False, True],
    }


@pytest.mark.slow
def test_training_for_real(folder, tmp_path):
    """Ten minutes of nobody's time: four policies of a few iterations each, taken up again on a second start."""
    more = ["--seeds", "1", "ppo.log_interval=4"]
    assert command(folder, "truth", tmp_path / "out", *more) == 0
    first = read(tmp_path / "out")
    assert first["gap"]["policy"]["after"] == 0.0 and first["settings"]["ppo"]["max_iterations"] == 8
    assert command(folder, "truth", tmp_path / "out", *more) == 0
    assert read(tmp_path / "out")["policies"] == first["policies"]
