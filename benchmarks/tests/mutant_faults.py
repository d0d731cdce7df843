"""One-line faults outside PPO, in eleven rooms from physics to environment.

Rows of `mutants.py`, which puts them into the code one at a time: (fault, file, old, new, tests). `old` stands in the
file exactly once; `tests` are arguments of pytest for tests of the default suite that can see the fault.
"""

P = "bayessim_mjx"
TIMESTEP, PHYSICS, RUNS, JSON, LOOP, TASK = (
    f"{P}/{name}.py"
    for name in ("physics/timestep", "physics/step", "runs/folder", "runs/manifest", "loop/outer_loop", "env/task")
)
EPISODES, COLLECTION = f"{P}/rollout/episodes.py", f"{P}/rollout/collection.py"
EFFECTS, DISTRIBUTIONS, LOGS = f"{P}/effects", f"{P}/distributions", f"{P}/logs"
FORCES = "tests/effects/test_actuator_forces.py"
SENSORS = "tests/effects/test_sensor_effects.py"
RECORDED = "tests/loop/test_recorded.py"
ALGEBRA = "tests/distributions/test_algebra.py"
MANIFEST = "tests/runs"
LOG = "tests/logs/test_resample.py"
SETS = "tests/diagnosis/evidence/test_sets.py"

FAULTS: tuple[tuple[str, str, str, str, tuple[str, ...]], ...] = (
    # physics
    (
        "a drive that is off still brakes with its kv", TIMESTEP, "return response * jnp.where(dof >= 0,",
        "return jnp.ones_like(response) * jnp.where(dof >= 0,", (FORCES, "-k", "falls_freely or own_edit"),
    ),
    (
        "the joint's limit does not hold behind effects", TIMESTEP,
        "torque = jnp.clip(_unclipped(own, plain, acting), *_joint_ranges(model))",
        "torque = _unclipped(own, plain, acting)", (FORCES, "-k", "own_edit"),
    ),
    (
        "RK4: actuators are corrected in the first stage alone", TIMESTEP, "data, _, _ = _actuated(own, data, memory)",
        "data = mjx.fwd_actuation(model, data)", (FORCES, "-k", "own_edit"),
    ),
    (
        "velocities are clipped to half the limit", TIMESTEP,
        "jnp.clip(data.qvel, -physics.max_qvel, physics.max_qvel)",
        "jnp.clip(data.qvel, -physics.max_qvel / 2, physics.max_qvel)",
        ("tests/physics/test_physics.py", "-k", "clipped"),
    ),
    # effects
    (
        "dry friction pushes on: level of the other direction", f"{EFFECTS}/support/friction.py",
        "jnp.where(asked > level[i, 1], level[i, 1], asked))", "jnp.where(asked > level[i, 1], level[i, 0], asked))",
        ("tests/effects/test_friction_effects.py", "-k", "by_direction"),
    ),
    (
        "a delay is rounded to whole sub-steps", f"{EFFECTS}/actuator_delay.py", "part = delay - whole",
        "part = 0.0 * whole", ("tests/effects/test_actuator_delay.py", "-k", "impulse"),
    ),
    (
        "a payload's inertia without Steiner's term", f"{EFFECTS}/payload.py", "reduced = mass * (load / total)",
        "reduced = 0.0 * load", ("tests/effects/test_body_effects.py", "-k", "point_mass"),
    ),
    (
        "a sensor's gain is undone twice where a log begins", f"{EFFECTS}/sensor_gain.py",
        "true = columns(at, motion.qpos, motion.qvel) / at.values(theta)",
        "true = columns(at, motion.qpos, motion.qvel) / at.values(theta) ** 2", (SENSORS, "-k", "start_in_the_middle"),
    ),
    # parameters
    (
        "a scaled mass keeps its inertia", f"{P}/parameters/writing.py",
        'draft["body_inertia"] = draft["body_inertia"].at[ids].multiply(ratios[:, None])',
        'draft["body_inertia"] = draft["body_inertia"].at[ids].multiply(1.0)',
        ("tests/parameters/test_write.py", "-k", "recompiling"),
    ),
    (
        "values left out of a mapping are low, not nominal", f"{P}/parameters/space.py",
        "theta = self.nominal.copy()", "theta = self.low.copy()", ("tests/parameters/test_space.py", "-k", "vectors"),
    ),
    (
        "the box excludes its ends", f"{P}/parameters/space.py", "jnp.all((theta >= self.low) & (theta <= self.high)",
        "jnp.all((theta > self.low) & (theta < self.high)", ("tests/parameters/test_space.py",),
    ),
    # distributions
    (
        "the slope of the probit chart has the other sign", f"{DISTRIBUTIONS}/charts.py", "0.5 * z * z + np.float32(",
        "-0.5 * z * z + np.float32(", ("tests/distributions/test_charts.py", "-k", "standard_normal or grid"),
    ),
    (
        "a product forgets how far its factors are apart", f"{DISTRIBUTIONS}/algebra.py",
        "_log_det(scales) - 0.5 * both[..., 0, 0] ** 2", "_log_det(scales)", (ALGEBRA, "-k", "every_point"),
    ),
    (
        "pruning may drop every component", f"{DISTRIBUTIONS}/algebra.py", "keep[np.argmax(scores)] = True",
        "keep[np.argmax(scores)] &= True", (ALGEBRA, "-k", "heaviest or break"),
    ),
    (
        "merged components lose what lies between them", f"{DISTRIBUTIONS}/algebra.py",
        "a * b * gap[:, None, :]], axis=-2)", "0 * a * gap[:, None, :]], axis=-2)", (ALGEBRA, "-k", "merging"),
    ),
    # loop
    (
        "checkpoints of two rounds share a number", LOOP,
        "return round_ * (n + 1) + done", "return round_ * n + done", ("tests/loop/test_loop.py", "-k", "steps_grow"),
    ),
    (
        "evaluations of former rounds compete under logs", LOOP, "supersede=info.truth is None)", "supersede=False)",
        ("tests/loop/test_loop.py", "-k", "newest_evaluation"),
    ),
    # rollout
    (
        "a world goes on after its end", EPISODES, "alive & (terminated + truncated == 0), action)", "alive, action)",
        ("tests/rollout/test_rollout.py", "-k", "stands_still"),
    ),
    (
        "a replay forgets the commands before it", PHYSICS, "memory=filled)", "memory=tuple(memory))",
        ("tests/physics/test_physics.py", RECORDED, "-k", "before_it or past_commands"),
    ),
    (
        "a termination on the last step counts as a truncation too", COLLECTION,
        'truncated = after.info["truncated"] * (1 - terminated)', 'truncated = after.info["truncated"]',
        ("tests/rollout/test_rollout.py", "-k", "termination"),
    ),
    # runs
    (
        "the worst evaluation is best", JSON, 'return max(evaluated, key=lambda c: c["evaluation"])',
        'return min(evaluated, key=lambda c: c["evaluation"])', (MANIFEST, "-k", "latest_and_best"),
    ),
    (
        "superseded evaluations go on competing", RUNS, '{**c, "evaluation": None} if supersede else c', "c",
        (MANIFEST, "-k", "something_else"),
    ),
    (
        "a manifest may name a path outside of its run", JSON,
        'parts[1] not in ("", ".", "..")', 'parts[1] not in ("",)', (MANIFEST, "-k", "outside"),
    ),
    # logs
    (
        "commands are sampled instead of averaged", f"{LOGS}/resample.py",
        "ctrl=_mean(log.time + log.late, log.ctrl, grid, dt, log.linear)",
        'ctrl=_interpolate(log.time, log.ctrl, inside, "linear")', (LOG, "-k", "irregular"),
    ),
    (
        "windows with the drive off are kept", f"{LOGS}/resample.py", "if on[a : a + length].all()]", "if on[a]]",
        (LOG, "-k", "drive_off"),
    ),
    (
        "noise of an encoder without the root of 12", f"{LOGS}/signals.py", "else grain) / np.sqrt(12.0), residual)",
        "else grain), residual)", (LOG, "-k", "quantum_and_noise"),
    ),
    # inference
    (
        "regions hold the share of draws that are less dense", f"{P}/inference/temperature.py",
        "density[1:] > density[0], density", "density[1:] < density[0], density",
        ("tests/inference/test_coverage_factor.py", "-k", "chi_square"),
    ),
    (
        "a marginal gain without the mass inside the box", f"{P}/inference/identify.py",
        "- logsumexp(weight + inside, axis=1)", "- 0 * logsumexp(weight + inside, axis=1)",
        ("tests/inference/test_identify.py", "-k", "by_hand"),
    ),
    (
        "Matern features with a Gaussian spectrum", f"{P}/inference/densities/mdrff.py", "if np.isfinite(nu):",
        "if False:",
        ("tests/inference/test_features.py",),
    ),
    # diagnosis
    (
        "superfluous effects stay in the answer", f"{P}/diagnosis/evidence/weighing.py",
        "limit, unlikely = left[key].excess + _relevant(left),", "limit, unlikely = -1.0,", (SETS,),
    ),
    (
        "noise is not taken out before the tolerance", f"{P}/diagnosis/statistics.py",
        "np.asarray(np.sqrt(np.maximum(np.square(rms) - np.square(noise), 0.0)))", "np.asarray(np.abs(rms))",
        ("tests/diagnosis/test_tolerance.py", "-k", "taken_out"),
    ),
    (
        "a set costs nothing more than a smaller one", f"{P}/diagnosis/selection/search_state.py",
        "return len(key) * float(np.log(odds))", "return 0.0", (SETS,),
    ),
    # environment
    (
        "a diverged world goes on from where it diverged", TASK, "lambda new, old: jnp.where(sound, new, old)",
        "lambda new, old: new", ("tests/env/test_env.py", "-k", "held_in_its_last_sound_state"),
    ),
)  # fmt: skip
