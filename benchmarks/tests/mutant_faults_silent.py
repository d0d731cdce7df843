"""One-line faults that give wrong numbers without a word: eight each in agents, loop, inference, diagnosis and logs.

Rows as in `mutant_faults.py`. How they were chosen: each room's files were read, with no look at their tests, for lines
whose fault no check would notice; of each kind some (a sign, an index off by one, a wrong key, a dropped factor, a
wrong axis, a silent default, swapped fields). Only then the nearest test files were looked for. `-m` is CI's selection.
The agents' need an environment with Stable-Baselines3, rsl_rl, skrl and torch.
"""

P = "bayessim_mjx"
AGENTS, LOOP, INFERENCE, DIAGNOSIS, LOGS = (
    f"{P}/{room}" for room in ("wrappers/agents", "loop", "inference", "diagnosis", "logs")
)
CI = ("-m", "ci or not slow")


def _tests(*files: str, k: str = "") -> tuple[str, ...]:
    return (*(f"tests/{file}.py" for file in files), *(("-k", k) if k else ()), *CI)


SETTINGS = ("tests/wrappers", "-k", "test_agent_settings", *CI)
SCORES = _tests("loop/test_scores")
BY_HAND = _tests("inference/test_by_hand")
LEFT = _tests("diagnosis/residual/test_by_hand")
MAP = _tests("logs/test_map", "logs/test_read")
RESAMPLE = _tests("logs/test_resample")

SILENT: tuple[tuple[str, str, str, str, tuple[str, ...]], ...] = (
    # agents and wrappers
    (
        "an agent's observations are divided by the root of their scale", f"{AGENTS}/shared.py",
        "- EPSILON, 0.0) ** 2", "- EPSILON, 0.0)", _tests("wrappers/test_agents", k="by_hand"),
    ),
    (
        "SB3: a resumed scale forgets how much it has seen", f"{AGENTS}/sb3.py",
        'for name in ("mean", "var", "count"):', 'for name in ("mean", "var"):',
        _tests("wrappers/test_agents_resumed", k="sb3"),
    ),
    (
        "SB3: lambda of GAE is gamma", f"{AGENTS}/sb3.py", "gae_lambda=ppo.gae_lambda", "gae_lambda=ppo.gamma",
        SETTINGS,
    ),
    (
        "skrl: no entropy bonus", f"{AGENTS}/skrl.py", "entropy_loss_scale=ppo.entropy_coef", "entropy_loss_scale=0.0",
        SETTINGS,
    ),
    (
        "rsl_rl: lambda of GAE is its default", f"{AGENTS}/rsl_rl.py", '"lam": ppo.gae_lambda', '"lam": 0.95', SETTINGS,
    ),
    (
        "mean return and mean length change places", f"{AGENTS}/shared.py", "returns, lengths = np.mean",
        "lengths, returns = np.mean", _tests("wrappers/test_agents", k="acts_as and sb3"),
    ),
    (
        "SB3: a termination counts as a time limit", f"{P}/wrappers/sb3.py", "bool(truncated[i])",
        "bool(truncated[i] | terminated[i])", _tests("wrappers/test_trainers", k="sb3_is_told"),
    ),
    (
        "Brax: an episode lasts one step longer", f"{P}/external.py", "(steps >= self.episode_length)",
        "(steps > self.episode_length)", _tests("wrappers/test_brax", k="protocol"),
    ),
    # loop
    (
        "the first of a round's real trajectories keeps the last round's posterior", f"{LOOP}/posterior.py",
        "jnp.arange(factors.logits.shape[0]) >= seen", "jnp.arange(factors.logits.shape[0]) > seen",
        SCORES,
    ),
    (
        "standard deviations of the surrogate's parameters are squared", f"{LOOP}/sources.py",
        "jnp.asarray(self.sds)[component] * noise_", "jnp.asarray(self.sds)[component] ** 2 * noise_",
        _tests("loop/test_sources", k="standard_deviations"),
    ),
    (
        "nine of ten actions of policy_rl_randomized are random", f"{LOOP}/collection.py",
        "RANDOM_SHARE), other, acted)", "RANDOM_SHARE), acted, other)",
        _tests("loop/test_sources", k="tenth"),
    ),
    (
        "schedules begin anew in every round", f"{LOOP}/outer_loop.py",
        "clock = round_ * ppo.max_iterations * ppo.num_steps", "clock = 0 * round_ * ppo.num_steps", SCORES,
    ),
    (
        "starts are drawn to their mean by N, not by N - 3", f"{LOOP}/noise.py",
        "self.freedom = max(self.count - 3, 0)", "self.freedom = self.count",
        _tests("loop/test_starts", k="by_hand"),
    ),
    (
        "the likelihood's noise is marginalised with twice the numbers", f"{LOOP}/likelihood.py",
        "shape = 0.5 * (self.count + 1)", "shape = self.count + 1", SCORES,
    ),
    (
        "what a posterior gains is judged without the widening it has", f"{LOOP}/examination.py",
        "else found.at(known).gain if", "else found.at(known).plain if", _tests("loop/test_keep_or_replace"),
    ),
    (
        "scores of neighbouring stretches count half", f"{LOOP}/likelihood_refinement.py",
        "(1 - lag / (lags + 1)) * (both + both.T)", "(1 - lag / (lags + 1)) * both", SCORES,
    ),
    # inference
    (
        "a posterior is widened by the square of the factor", f"{INFERENCE}/temperature.py",
        "return q.means, q.scales * factor", "return q.means, q.scales * factor**2", BY_HAND,
    ),
    (
        "a widening is judged on the sets that chose it", f"{INFERENCE}/product_calibration.py",
        "_best(gains[:, part != p])",
        "_best(gains[:, part == p])", BY_HAND,
    ),
    (
        "the shape of a Pareto tail without its prior", f"{INFERENCE}/final_importance_sampling.py",
        "return (n * shape + 10 * 0.5) / (n + 10), scale", "return shape, scale", BY_HAND,
    ),
    (
        "the prior's draws have heavy tails that their density has not", f"{INFERENCE}/importance.py",
        "stretch[part == len(q.weights) - 1] = 1.0", "stretch[part == len(q.weights)] = 1.0", BY_HAND,
    ),
    (
        "evidence of several trajectories is summed, not averaged", f"{INFERENCE}/misspecification.py",
        "np.arctan(np.mean(np.tan(", "np.arctan(np.sum(np.tan(",
        _tests("inference/test_misspecification", k="combination"),
    ),
    (
        "a product is moved by what chance adds too", f"{INFERENCE}/local_recalibration.py",
        "return mean * (1 - chance / statistic), cov",
        "return mean, cov", BY_HAND,
    ),
    (
        "truncated draws are the posterior's, not the prior's", f"{INFERENCE}/rounds.py",
        "jnp.exp(-wide.log_gain(theta)), 0.0", "1.0, 0.0", _tests("inference/test_proposal", k="truncated"),
    ),
    (
        "a summary's lags go back in time", f"{INFERENCE}/summaries/correlations.py",
        "tau[lag:].T @ actions[: steps - lag]", "tau[: steps - lag].T @ actions[lag:]",
        _tests("inference/test_summarizers", k="corr"),
    ),
    # diagnosis
    (
        "what servos are fed back of velocities is never late", f"{DIAGNOSIS}/evidence/doubts.py",
        "-model.actuator_biasprm[:, 1:3], 0.0)", "-model.actuator_biasprm[:, 1:3] * [1.0, 0.0], 0.0)",
        _tests("diagnosis/evidence/test_doubts", k="servos"),
    ),
    (
        "no number of an effect may be neutral", f"{DIAGNOSIS}/evidence/parameters.py",
        "return float(logsumexp(terms) - np.log(cases))", "return 0.0",
        _tests("diagnosis/evidence/test_parameters", k="may_be_neutral"),
    ),
    (
        "as many degrees of freedom as conditions", f"{DIAGNOSIS}/statistics.py", "np.maximum(count - 1.0, least)",
        "np.maximum(count, least)", _tests("diagnosis/selection/test_uncertainty", k="conditions_that_count"),
    ),
    (
        "the pull of a start's prior has the other sign", f"{DIAGNOSIS}/fitting/quadratic.py",
        "pull = times(B_own.mT, r) - x_own / D**2", "pull = times(B_own.mT, r) + x_own / D**2",
        _tests("diagnosis/fitting/test_quadratic"),
    ),
    (
        "every part of a window costs what the start's prior costs in all", f"{DIAGNOSIS}/fitting/quadratic.py",
        "c + (q.c[w] - c.sum()) / count,", "c + (q.c[w] - c.sum()),", _tests("diagnosis/fitting/test_quadratic"),
    ),
    (
        "what was not calibrated gets a twelfth of its range as width", f"{DIAGNOSIS}/correction.py",
        "UNIFORM * (p.high - p.low) if", "UNIFORM**2 * (p.high - p.low) if",
        _tests("diagnosis/test_correction", k="as_wide"),
    ),
    (
        "a joint's share of the gap with half the gradient", f"{DIAGNOSIS}/residual/where.py", "drop = d * (2 * g -",
        "drop = d * (g -", LEFT,
    ),
    (
        "white noise from second differences by 4, not 6", f"{DIAGNOSIS}/residual/disturbance.py",
        "np.diff(r, 2, axis=1) ** 2 / 6.0", "np.diff(r, 2, axis=1) ** 2 / 4.0", LEFT,
    ),
    # logs
    (
        "a drive that was on for half a step was on", f"{LOGS}/resample.py", "[:, 0] > 1.0 - 1e-6)", "[:, 0] > 0.5)",
        RESAMPLE,
    ),
    (
        "commands that run linearly rise twice as fast", f"{LOGS}/resample.py", "since + 0.5 * slope[at] * since**2",
        "since + slope[at] * since**2", _tests("logs/test_as_they_are"),
    ),
    (
        "angular velocities are in world axes", f"{LOGS}/signals.py", "dw * v - np.cross(v, dv)",
        "dw * v + np.cross(v, dv)", MAP,
    ),
    (
        "the noise of an orientation is that of its quaternion", f"{LOGS}/log.py", "turned = [2.0 * float(",
        "turned = [1.0 * float(", _tests("diagnosis/fitting/test_scales"),
    ),
    (
        "an offset is turned round with the sign", f"{LOGS}/mapping.py",
        "return self.sign * scale, self.offset", "return self.sign * scale, self.sign * self.offset", MAP,
    ),
    (
        "the row before a gap belongs to what comes after it", f"{LOGS}/pieces.py",
        "edges = [0, *(gaps + 1), len(time)]", "edges = [0, *gaps, len(time)]",
        _tests("logs/test_refused", "logs/test_read"),
    ),
    (
        "commands that are late twice are late once", f"{LOGS}/log.py", '"commands_late": self.late + late}',
        '"commands_late": late}', RESAMPLE,
    ),
    (
        "a quaternion's sign is mended in one row alone", f"{LOGS}/check.py", "flips = np.cumprod(np.where(",
        "flips = np.array(np.where(", MAP,
    ),
)  # fmt: skip
