"""The outer loop on the pendulum with tiny budgets: order of a round, resume, ablation, recorded motion."""

import dataclasses
import types

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from bayessim_mjx import config, loop, memory, registry, rl
from bayessim_mjx.distributions import Distribution
from bayessim_mjx.errors import UserError
from bayessim_mjx.loop import outer_loop
from bayessim_mjx.loop.state import Evidence
from bayessim_mjx.rollout import replay

TINY = [
    "env.numEnvs=8", "ppo.num_steps=8", "ppo.num_minibatches=2", "ppo.num_epochs=1", "ppo.max_iterations=3",
    "ppo.log_interval=1", "ppo.save_interval=1", "ppo.hidden_actor=[8]", "ppo.hidden_critic=[8]",
    "bayessim.trainTrajs=400", "bayessim.realEvals=4", "bayessim.realIters=2", "bayessim.realTrajs=2",
    "bayessim.components=3", "bayessim.hiddenLayers=[16]", "bayessim.trainTrajLen=8", "bayessim.ftuneRL=True",
    "bayessim.checkTrajs=0", "bayessim.refine=off",
]  # fmt: skip


@dataclasses.dataclass
class Recorder:
    """Checkpoints and monitor in one, in memory."""

    saved: list = dataclasses.field(default_factory=list)
    calls: list = dataclasses.field(default_factory=list)

    def save(self, step, tree, *, evaluation=None, meta=None, supersede=False):
        self.saved.append((step, jax.device_get(tree), evaluation, meta))

    def training(self, round_, metrics, state):
        self.calls.append(("training", round_, int(state.train.iteration)))

    def round(self, info, policy):
        self.calls.append(("round", info.round, None))


def settings(*more: str) -> config.Config:
    return config.load("Pendulum", overrides=[*TINY, *more])


@pytest.fixture(scope="module")
def env():
    return registry.make("Pendulum", config=settings())


@pytest.fixture(scope="module")
def parts(env):
    return loop.make(settings(), env)


@pytest.fixture(scope="module")
def finished(parts):
    recorder = Recorder()
    state, rounds = loop.run(parts, loop.init(parts), recorder, recorder)
    return state, rounds, recorder


def assert_equal(a, b):
    flat_a, tree_a = jax.tree.flatten(a)
    flat_b, tree_b = jax.tree.flatten(b)
    assert tree_a == tree_b
    for x, y in zip(flat_a, flat_b, strict=True):
        np.testing.assert_array_equal(np.asarray(x), np.asarray(y))


def test_a_round_trains_then_infers(finished):
    state, rounds, recorder = finished
    assert [call[:2] for call in recorder.calls] == [("training", 0)] * 3 + [("round", 0)] + [("training", 1)] * 3 + [
        ("round", 1)
    ]
    assert int(state.round) == 2 and int(state.train.iteration) == 6  # ftuneRL: one policy over all rounds
    assert len(rounds) == 2


def test_the_first_round_trains_on_the_prior_and_the_second_on_the_posterior(finished):
    _, rounds, _ = finished
    assert float(rounds[0].domain.prior_weight) == 1.0
    assert_equal(rounds[1].domain, rounds[0].posterior)


def test_simulated_trajectories_come_from_the_prior_also_in_later_rounds(finished, parts):
    state, _, _ = finished
    thetas = np.asarray(state.thetas).reshape(2, 400, 2)
    for rows in thetas:  # U[0.01, 2]: mean 1.005, sd 0.574; standard error of the mean 0.029
        assert rows.mean(0) == pytest.approx([1.005, 1.005], abs=0.12)
        assert rows.std(0) == pytest.approx([0.574, 0.574], abs=0.06)
    assert not np.array_equal(thetas[0], thetas[1])


def test_real_trajectories_accumulate(finished):
    state, rounds, _ = finished
    assert state.real_features.shape[0] == 4
    assert np.all(np.any(np.asarray(state.real_features) != 0, axis=1))
    assert all(info.real.observation.shape == (2, 9, 3) for info in rounds)


def test_scores_know_the_truth(finished):
    _, rounds, _ = finished
    info = rounds[-1]
    np.testing.assert_allclose(info.truth, [1.0, 0.5], atol=1e-4)
    # the prior's log density is -2 log 1.99
    assert info.scores["log_p_truth"] - info.scores["gain_over_prior"] == pytest.approx(-2 * np.log(1.99), abs=1e-3)
    assert 0 <= info.scores["credible_level"] <= 1
    assert set(info.scores) >= {"contraction/pendulum_mass_mult", "contraction/pendulum_length_mult"}


def test_checkpoint_steps_grow_and_rounds_are_evaluated(finished):
    _, rounds, recorder = finished
    steps = [step for step, *_ in recorder.saved]
    assert steps == sorted(set(steps)) and len(steps) == 8
    evaluated = [(step, value) for step, _, value, _ in recorder.saved if value is not None]
    assert [value for _, value in evaluated] == [pytest.approx(info.returns.mean()) for info in rounds]


# not in CI: that nothing is compiled again is told of inference by test_ranges.py::test_another_move_compiles_nothing,
# of training by rl/test_train.py::test_one_program_for_every_seed_domain_and_number_of_iterations
@pytest.mark.slow
def test_later_rounds_compile_nothing(env):
    """Prior or posterior, more data, more real trajectories: the same programs."""
    parts = loop.make(settings("bayessim.realIters=3"), env)
    state, compiled, counts = loop.init(parts), [], []
    listener = lambda event, seconds, **_: compiled.append(event)  # noqa: E731
    jax.monitoring.register_event_duration_secs_listener(listener)
    try:
        for _ in range(3):
            state, _info = loop.step(parts, loop.train(parts, state))
            counts.append(compiled.count("/jax/core/compile/backend_compile_duration"))
    finally:
        jax.monitoring.unregister_event_duration_listener(listener)
    assert counts[2] == counts[1], counts  # the second round still meets a product of several for the first time


LONG = [pytest.mark.slow]


@pytest.mark.parametrize("stop", [pytest.param(1, marks=LONG), 3, pytest.param(4, marks=LONG)])
def test_a_resumed_run_is_the_unkilled_run_bit_for_bit(finished, parts, stop):
    """From a checkpoint within round 0's training, after round 0, and within round 1."""
    state, rounds, recorder = finished
    restored = jax.tree.map(jnp.asarray, recorder.saved[stop][1]["state"])
    resumed, later = loop.run(parts, restored)
    assert_equal(resumed, state)
    np.testing.assert_array_equal(later[-1].returns, rounds[-1].returns)


def test_a_state_comes_back_from_disk_as_it_was(finished):
    """A weak type is lost there, and a run that goes on would compile its fit again."""
    leaves = jax.tree_util.tree_leaves_with_path(finished[0])
    assert [jax.tree_util.keystr(path) for path, x in leaves if getattr(x, "weak_type", False)] == []


def test_another_seed_draws_other_trajectories(env, finished):
    other = loop.make(settings("seed=1"), env)
    draws = other.source.real(other.key(0, "real"), 0, 2, rl.policy_of(finished[0].train))[0]
    assert not np.array_equal(np.asarray(draws), np.asarray(finished[0].real_features[:2]))


@pytest.mark.slow
def test_a_policy_with_a_memory_acts_in_all_rounds_and_its_memory_is_no_action(env, parts):
    """The features are those of a policy without one; random actions leave the memory alone."""
    more = ("ppo.memory=4", "bayessim.collectPolicy=policy_rl_randomized", "ppo.num_minibatches=2")
    remembering = loop.make(settings(*more), env)
    assert remembering.feature_size == parts.feature_size
    assert remembering.source.channels == parts.source.channels
    state, (_, info) = loop.run(remembering, loop.init(remembering))
    assert int(state.round) == 2 and np.isfinite(info.returns).all()
    assert info.real.action.shape[-1] == env.action_size
    assert "gru" in state.train.params["actor"]


@pytest.mark.parametrize("truth", [None, np.zeros(1)])
def test_under_logs_only_the_newest_evaluation_counts(monkeypatch, truth):
    """There is no truth then, and every round was evaluated on physics of its own."""
    told, returns = [], np.array([1.0, 3.0])
    saves = types.SimpleNamespace(save=lambda step, tree, **kwargs: told.append(kwargs))
    monkeypatch.setattr(loop.outer_loop, "train", lambda parts, state, progress: state)
    info = types.SimpleNamespace(truth=truth, returns=returns, seconds={})
    monkeypatch.setattr(
        loop.outer_loop, "step", lambda parts, state, begin: (dataclasses.replace(state, round=state.round + 1), info)
    )
    monkeypatch.setattr(rl, "policy_of", lambda state: None)
    blank = dict.fromkeys((f.name for f in dataclasses.fields(loop.LoopState)), jnp.zeros(0))
    train = types.SimpleNamespace(iteration=jnp.int32(3), env_steps=jnp.uint32(24))
    state = loop.LoopState(**{**blank, "round": jnp.int32(0), "train": train})
    ppo = types.SimpleNamespace(max_iterations=3, save_interval=1)
    parts = types.SimpleNamespace(
        settings=types.SimpleNamespace(realIters=2, ftuneRL=True),
        config=types.SimpleNamespace(ppo=ppo),
        finished=lambda state: int(state.round) == 2,
    )
    loop.run(parts, state, saves)
    assert [(t["supersede"], t["evaluation"]) for t in told] == [(truth is None, 2.0)] * 2


def test_without_a_model_the_domain_stays_the_prior(env):
    ablation = loop.make(settings("bayessim.modelClass=None", "bayessim.realIters=1"), env)
    state, rounds = loop.run(ablation, loop.init(ablation))
    assert rounds[0].posterior is None and float(state.domain.prior_weight) == 1.0
    assert rounds[0].returns.shape == (4,)


@pytest.mark.slow
@pytest.mark.ci
def test_a_new_policy_each_round_where_asked_for(env):
    fresh = loop.make(settings("bayessim.ftuneRL=False", "bayessim.modelClass=None"), env)  # no inference
    state, _ = loop.run(fresh, loop.init(fresh))
    assert int(state.train.iteration) == 3  # the last round's own iterations


@pytest.mark.slow
def test_a_policy_that_goes_on_starts_its_sums_anew_in_new_worlds(env):
    """Curiosity's discounted sums run over worlds: those of worlds that are gone do not go on in their successors."""
    curious = loop.make(settings("bayessim.modelClass=None", "ppo.rnd.weight=1.0"), env)
    state = loop.init(curious, trains=False)
    rnd = state.train.extensions["rnd"]
    old = rnd.episodes.replace(running_return=jnp.full(8, 5.0), running_length=jnp.full(8, 7.0))
    rnd = rnd.replace(discounted=jnp.full(8, 3.0), episodes=old, steps=jnp.int32(24))
    state = dataclasses.replace(state, train=state.train.replace(extensions={"rnd": rnd}, iteration=jnp.int32(3)))
    after = loop.step(curious, state)[0].train
    novel = after.extensions["rnd"]
    for sums in (novel.discounted, novel.episodes.running_return, after.episodes.running_return):
        assert np.array_equal(sums, np.zeros(8))
    assert np.array_equal(novel.episodes.partial, after.episodes.partial)  # of the new worlds' first episodes
    assert int(novel.steps) == 24 and int(after.iteration) == 3  # the learner's own are kept
    assert_equal(novel.predictor, rnd.predictor)


@pytest.mark.slow
@pytest.mark.ci
def test_policy_dependent_posteriors_are_kept_from_their_time(env):
    dependent = loop.make(settings("bayessim.collectPolicy=policy_rl_randomized"), env)
    assert dependent.capacity == 0  # only a round's own simulations belong to its policy
    state, info = loop.step(dependent, loop.train(dependent, loop.init(dependent)))
    first = jax.tree.map(lambda leaf: np.asarray(leaf[:2]), state.real_posteriors)
    state, info = loop.step(dependent, loop.train(dependent, state))
    assert_equal(jax.tree.map(lambda leaf: np.asarray(leaf[:2]), state.real_posteriors), first)


@pytest.fixture(scope="module")
def recorded(env, tmp_path_factory):
    """Logs made with mass 1.4 and length 0.7: sine torque from six starts, 3 s each."""
    folder, truth = tmp_path_factory.mktemp("logs"), np.array([1.4, 0.7])
    time = np.arange(61) * env.dt
    starts = np.linspace(-2.5, 2.5, 6)[:, None]
    command = 2.0 * np.sin(np.outer(np.linspace(1.0, 4.0, 6), time[:-1]))[..., None]
    motion = replay(env.physics, starts, np.zeros_like(starts), command, np.tile(truth, (6, 1)))
    for i in range(6):
        ctrl = np.concatenate([command[i], command[i][-1:]])
        measured = {name: np.asarray(motion[name][i], np.float64) for name in ("qpos", "qvel")}
        joint, actuator = env.mj_model.joint(0).name, env.mj_model.actuator(0).name
        header = f"time,ctrl:{actuator},qpos:{joint},qvel:{joint}"
        table = np.column_stack([time, ctrl, measured["qpos"], measured["qvel"]])
        np.savetxt(folder / f"run{i}.csv", table, delimiter=",", header=header, comments="")
    return folder, truth


@pytest.mark.slow
def test_logs_give_back_the_parameters_they_were_made_with(env, recorded):
    folder, truth = recorded
    from_logs = settings(
        f"real.logs={folder}", "bayessim.trainTrajs=3000", "bayessim.trainTrajLen=20", "bayessim.realTrajs=6",
        "bayessim.realIters=1", "bayessim.hiddenLayers=[64,64]", "ppo.max_iterations=1",
    )  # fmt: skip
    parts = loop.make(from_logs, env)
    state, rounds = loop.run(parts, loop.init(parts))
    posterior = rounds[0].posterior
    assert float(posterior.log_gain(jnp.asarray(truth, jnp.float32))) > 2.0
    assert np.all(np.abs(np.asarray(posterior.mean()) - truth) < 4 * np.asarray(posterior.sd()) + 0.05)
    assert rounds[0].truth is None and "log_p_truth" not in rounds[0].scores
    assert rounds[0].predictive["qpos"].shape == (loop.PREDICTIVE_DRAWS, 21, 1)


@pytest.mark.slow
def test_too_few_segments_are_refused_with_the_numbers(env, recorded):
    with pytest.raises(UserError, match="18 segments.*realIters"):
        loop.make(settings(f"real.logs={recorded[0]}", "bayessim.trainTrajLen=20", "bayessim.realTrajs=10"), env)
    with pytest.raises(UserError, match="needs real.logs"):
        loop.make(settings("bayessim.collectPolicy=policy_replay"), env)


def test_summaries_that_do_not_fit_are_refused(env, monkeypatch):
    """Two rounds of a million rows: 9 observations of 3, 8 actions, two parameters, 4 bytes each."""
    million = settings("bayessim.trainTrajs=1000000")
    monkeypatch.setattr(memory, "installed", lambda: 2e6 * 37 * 4 - 1)
    with pytest.raises(UserError, match=r"trainTrajs = 1000000 summaries of 35 features: needs at least 296 MB"):
        loop.make(million, env)
    monkeypatch.setattr(memory, "installed", lambda: 2e6 * 37 * 4)
    loop.make(million, env)


@pytest.mark.parametrize(
    ("means", "done"), [((1.5, 1.0, 1.0, 1.0), 3), ((1.0, 1.01, 1.0, 1.0), 2), ((1.0, 1.2, 1.0, 1.2), 4)]
)
def test_a_run_ends_after_a_round_that_leaves_the_posterior_as_it_was(env, monkeypatch, means, done):
    parts, given = loop.make(settings("bayessim.realIters=4", "bayessim.untilSettled=True"), env), iter(means)

    def infer(of, state, policy, begin):
        posterior = Distribution.gaussian(env.space, [next(given), 1.0], 0.1, 3)
        return dataclasses.replace(state, domain=posterior), Evidence()

    monkeypatch.setattr(outer_loop, "infer", infer)
    state, rounds = loop.run(parts, loop.init(parts))
    assert int(state.round) == done and parts.finished(state)
    assert [bool(info.settled) for info in rounds] == [False] * (done - 1) + [done < 4]
