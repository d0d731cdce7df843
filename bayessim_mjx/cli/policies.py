"""Checkpoints by name, and the policies in them."""

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from bayessim_mjx.config import Config, replace
from bayessim_mjx.errors import UserError

if TYPE_CHECKING:
    from bayessim_mjx.runs import Run


def find_checkpoint(which: str, task: str | None, logdir: str) -> tuple[Path, "Run | None"]:
    """(checkpoint folder, its run) for "latest", "best" (of the task's newest run) or a run's or checkpoint's path.

    For "best" it is the newest run that trained: a run of 0 iterations has a policy that nobody looks for.
    """
    from bayessim_mjx.runs import MANIFEST, Run, checkpoints, latest_run

    if which in ("latest", "best"):
        if not task:
            raise UserError(f"--checkpoint {which}: give --task NAME, or the path of a run")
        run = latest_run(logdir, task, trained=which == "best")
        if which == "best" and run.manifest["best"] is None:
            raise UserError(_without_best(run, logdir, task))
        return run.checkpoint(which), run
    path = Path(which)
    if (path / MANIFEST).is_file():
        run = Run.open(path)
        return run.checkpoint("latest" if run.manifest["best"] is None else "best"), run
    allowed = "give a run, one of its checkpoints, latest or best"
    if not path.is_dir():
        raise UserError(f"--checkpoint {which}: no such folder; {allowed}")
    if not (path / checkpoints.INDEX).is_file():
        raise UserError(f"--checkpoint {which}: neither a run nor a checkpoint (no {MANIFEST} in it); {allowed}")
    checkpoints.read_index(path)
    parents = path.absolute().parents
    return path, Run.open(parents[1]) if (parents[1] / MANIFEST).is_file() else None


def origin(path: Path, run: "Run | None", newest_of: str = "") -> str:
    """Say of which run a checkpoint is, and its return there: `run 2026-01-01_10-00-00, return 98.5`; "" without a run.

    Args:
        newest_of: what was searched, for "latest" and "best": the folder of all runs; "" for a path.
    """
    from bayessim_mjx.quantities import compact
    from bayessim_mjx.runs import find_runs

    if run is None:
        return ""
    score = next((c["evaluation"] for c in run.checkpoints if run.path / c["path"] == path), None)
    parts = [f"run {run.path.name}", *([] if score is None else [f"return {compact(score)}"])]
    runs = find_runs(newest_of, run.manifest["task"]) if newest_of else []
    if len(runs) > 1:
        newest = "newest" if runs[-1].path == run.path else "newest that trained,"
        parts.append(f"{newest} of {len(runs)} runs; --checkpoint RUN for another")
    return ", ".join(parts)


def _without_best(run: "Run", logdir: str, task: str) -> str:
    """Say that the newest run has no best, and what may be given in its place."""
    from bayessim_mjx.runs import find_runs

    best = [other.path for other in find_runs(logdir, task) if other.manifest["best"] is not None]
    older = f", or --checkpoint {best[-1]}, the newest run that has a best" if best else ""
    status = run.manifest["status"]
    return f"--checkpoint best: {run.path}, the newest run ({status}), has none; give --checkpoint latest{older}"


def pin_policy(config: Config) -> Config:
    """`bayessim.policyCheckpt` as the path of one checkpoint folder, which has to be there."""
    if config.bayessim.policyCheckpt is None:
        return config
    path, _ = find_checkpoint(config.bayessim.policyCheckpt, config.task, config.logdir)
    return replace(config, bayessim={"policyCheckpt": str(path.absolute())})


def of_another_task(config: Config, env: Any) -> str:
    """Say of which task the policy is that training begins with, where it is another one; "" for the same.

    Raises:
        UserError: its networks do not fit this task; naming both tasks.
    """
    if config.bayessim.policyCheckpt is None:
        return ""
    from bayessim_mjx.runs.checkpoints import MADE_WITH

    path, run = find_checkpoint(config.bayessim.policyCheckpt, None, "")
    if run is None or run.manifest["task"] == config.task:
        return ""
    theirs = f"{path}: task_name = {run.manifest['task']!r}, but the task is {config.task!r}"
    try:
        load_policy(path, privileged(config, env)[0], config)
    except UserError as error:
        how = str(error).removeprefix(f"{path}: ").partition(f": {MADE_WITH}")[0]
        raise UserError(f"--checkpoint {theirs}; give a policy of {config.task} ({how})") from None
    return f"{theirs}: both have as many observations and actions, and the policy is taken over as it is"


def physics_settings(args: argparse.Namespace) -> dict[str, tuple[str, Any]]:
    """Return the settings of `--randomize` and `--domain`; those of a run that is its domain hold without others.

    Raises:
        UserError: both flags; a domain that is neither nominal or prior nor a folder or file there is.
    """
    where = args.domain or ("prior" if args.randomize else "nominal")
    if args.domain and args.randomize:
        raise UserError(f"--randomize and --domain {where}: give one of them; --randomize is --domain prior")
    given = {"--randomize": ("task.randomize", where != "nominal")}
    if where in ("nominal", "prior"):
        return given
    path = Path(where).absolute()
    if path.is_dir():
        from bayessim_mjx.wrappers.worlds import run_of

        config, path = run_of(path)
        params = path.parents[1] / "params"
        args.task = args.task or config.task
        args.cfg_env, args.cfg_train = args.cfg_env or params / "env.yaml", args.cfg_train or params / "train.yaml"
    elif not path.is_file():
        raise UserError(
            f"--domain {where}: allowed are nominal, prior, the folder of a run or of one of its checkpoints, and a "
            "file that Distribution.save wrote"
        )
    return {**given, "--domain": ("domain", str(path))}


def load_policy(path: Path, env: Any, config: Config) -> Any:
    """Return the policy in a checkpoint folder; its networks have to be those of `config`."""
    import jax

    from bayessim_mjx import rl
    from bayessim_mjx.runs import checkpoints

    make = lambda key: rl.policy_of(rl.init(env, config.ppo, key))  # noqa: E731
    return checkpoints.restore(path, {"policy": jax.eval_shape(make, jax.random.PRNGKey(0))})[0]["policy"]


def space_seen(run: "Run | None") -> Any:
    """Return the parameters that the policy of a run sees, with the ranges of their units; None: it sees none."""
    from bayessim_mjx import registry

    if run is None or not run.config.ppo.policy_theta:
        return None
    return registry.make(run.config.task, config=run.config).space


def _ranges(space: Any) -> str:
    return ", ".join(
        f"{n} {low:g} to {high:g}" for n, low, high in zip(space.names, space.low, space.high, strict=True)
    )


def privileged(config: Config, env: Any, run: "Run | None" = None) -> tuple[Any, Any]:
    """(`env` as the policy of `config` is trained in it, the teacher of ppo.teacher or None).

    run: that of the policy, where it is trained already.
    """
    from bayessim_mjx.rl import groups, recurrent
    from bayessim_mjx.rl import privileged as shown

    teacher = None
    if config.ppo.teacher is not None:
        env, teacher = _taught(config.ppo.teacher, config, env)
    env = groups.for_policy(env, config.ppo.actor_groups)
    if config.ppo.policy_theta:
        env = shown.for_policy(env, space_seen(run))
    return recurrent.remembering(env, config.ppo.memory_size) if config.ppo.memory else env, teacher


def _taught(which: str, config: Config, env: Any) -> tuple[Any, Any]:
    """(`env` with the group that the teacher sees where it is not the student's, the teacher)."""
    from bayessim_mjx.rl import groups
    from bayessim_mjx.rl import privileged as shown

    path, run = find_checkpoint(which, None, "")
    alone = {"memory": 0, "memory_layers": 1, "gradient_length": 0}
    settings = replace(config, ppo=alone) if run is None else run.config
    theirs = settings.ppo
    if theirs.memory:
        raise UserError(f"ppo.teacher = {which!r}: it has a memory, ppo.memory = {theirs.memory}; give one without")
    seen, space = groups.for_policy(env, theirs.actor_groups), space_seen(run)
    teacher = load_policy(path, shown.for_policy(seen, space) if theirs.policy_theta else seen, settings)
    if theirs.actor_groups or config.ppo.actor_groups:
        env = groups.shown(env, "teacher", theirs.actor_groups or ("policy",))
        return shown.teacher_knowing(env, space) if theirs.policy_theta else env, teacher
    return shown.for_teacher(env, space) if theirs.policy_theta else env, teacher


def warm_start(train: Any, config: Config, env: Any, say: Callable[[str], None] = lambda _: None) -> Any:
    """Return the training state with actor and normaliser of `bayessim.policyCheckpt`, if set; the critic is new.

    `main` and `train` call it for the state that a run begins with, not when they resume one. `loop.init` does not read
    files: a program of your own that is to start from a policy calls this on `loop.init(parts).train`. With
    `bayessim.ftuneRL=False` only round 0 starts from the policy, as later rounds train new ones.

    Args:
        say: what it gets is one line that says what is taken over and what is new.

    Raises:
        UserError: the policy sees theta in units of other ranges than those of `env`.
    """
    if config.bayessim.policyCheckpt is None:
        return train
    path = Path(config.bayessim.policyCheckpt)
    policy = load_policy(path, env, config)
    if config.ppo.policy_theta:
        seen = space_seen(find_checkpoint(str(path), None, "")[1])
        if seen is not None and _ranges(seen) != _ranges(env.space):
            raise UserError(
                f"bayessim.policyCheckpt = {str(path)!r}: the policy sees the parameters in units of {_ranges(seen)}, "
                f"but here the ranges are {_ranges(env.space)}; give those of its run (params/env.yaml by --cfg_env)"
            )
    say(
        f"from {path}: the policy and the statistics of its observations; critic, state of Adam and learning rate "
        f"({float(train.learning_rate):g}) are new"
    )
    normalizer = {**train.normalizer, "policy": policy.normalizer}
    return train.replace(params={**train.params, "actor": policy.actor}, normalizer=normalizer)
