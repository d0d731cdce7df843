"""`python -m bayessim_mjx.main --task Pendulum`: adaptive domain randomisation; also `bayessim-mjx [train|play]`."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Sequence
from typing import Any

from bayessim_mjx import cli
from bayessim_mjx.config import Config, to_yaml
from bayessim_mjx.device import setup_jax
from bayessim_mjx.errors import UserError

DESCRIPTION = "Adaptive domain randomisation: rounds of PPO, evaluation, simulation and inference."


class Watched:
    """The loop's monitor with stops at whole states: after a log interval of training, and after a round."""

    def __init__(self, session: Any, stop: cli.Stop, save: Callable[[int, Any], Any]):
        self.session, self.stop, self.save = session, stop, save

    def training(self, round_: int, metrics: dict[str, float], state: Any) -> None:
        self.session.training(round_, metrics, state)
        self.stop.save(lambda: self.save(round_, state))

    def round(self, info: Any, policy: Any) -> None:
        self.session.round(info, policy)
        self.stop.save(lambda: None)  # the loop saved it just now


def _prepare(args: argparse.Namespace) -> tuple[Config, Any]:
    """(settings, run to go on with or None)."""
    from bayessim_mjx.runs import Run

    if args.resume:
        run = Run.open(args.resume)
        return cli.resumed_config(args, run.config), run
    more = {"--checkpoint": ("bayessim.policyCheckpt", args.checkpoint)} if args.checkpoint else {}
    return cli.pin_policy(cli.config_of(args, more)), None


def film(env: Any, config: Config, thetas: Any) -> Callable[[Any, int], Any] | None:
    """(policy, control steps) -> qpos [T+1, nq] of one episode at thetas [1, d]; None where no video is to be made."""
    import jax
    import numpy as np

    from bayessim_mjx.rollout import rollout

    if not config.monitor.video or not hasattr(env, "physics"):
        return None

    def motion(policy: Any, length: int) -> np.ndarray:
        actor = policy.replace(deterministic=True)
        return np.asarray(rollout(env, actor, jax.random.PRNGKey(config.seed), thetas, length).qpos[0])

    return motion


def _run(config: Config, run: Any, command: Sequence[str], console: Any) -> int:
    import numpy as np

    from bayessim_mjx import loop, registry, runs
    from bayessim_mjx.monitor import video
    from bayessim_mjx.monitor.opening import opening
    from bayessim_mjx.monitor.session import Session

    if config.randomization.get("randomize") is False and config.bayessim.modelClass is not None:
        raise UserError("task.randomize = False: there is nothing to infer; use bayessim_mjx.train for PPO alone")
    device = setup_jax(config)
    env = registry.make(config.task, config=config)
    console.start(opening(config, env, device))
    console.phase("setting up")
    parts = loop.make(config, env)
    state: Any = loop.init(parts)
    resumed = run is not None and bool(run.checkpoints)
    state = state.replace(train=cli.warm_start(state.train, config, env)) if not resumed else state
    if run is None:
        run = runs.Run.create(config.logdir, config.task, config.name, config, command)
    elif resumed:
        state = run.restore("latest", loop.tree_of(parts, state), fall_back=True)[0]["state"]
    run.set_status("running")

    def save(round_: int, now: Any) -> None:
        step = loop.checkpoint_step(parts, round_, now.train)
        run.save(step, loop.tree_of(parts, now), meta={"round": int(now.round), "iteration": int(now.train.iteration)})

    truth = None if parts.source is None else parts.source.truth
    thetas = np.asarray(env.space.nominal if truth is None else truth)[None]
    motion = film(env, config, thetas)
    model = None if motion is None else video.model_at(env, thetas[0])
    console.say(f"run folder {run.path}")
    with cli.graceful() as stop:
        session = Session(run.path, config, env, console, motion, state if resumed else None, model)
        session.describe(to_yaml(config.to_dict()))
        try:
            _, rounds = loop.run(parts, state, run, Watched(session, stop, save))
        except KeyboardInterrupt:
            run.set_status("interrupted")
            console.say(f"interrupted; go on with --resume {run.path}")
            raise
        finally:
            session.close()
        run.set_status("finished")
        _report(console, env, rounds, truth)
        console.say(f"best policy: python -m bayessim_mjx.play --checkpoint {run.path} --video")
        console.say(f"pictures:    tensorboard --logdir {run.path} --samples_per_plugin images=1000")
    return 0


def _report(console: Any, env: Any, rounds: Sequence[Any], truth: Any) -> None:
    """The closing table of parameters."""
    import numpy as np

    posterior = rounds[-1].posterior if rounds else None
    if posterior is None:
        return
    mean, sd = np.asarray(posterior.mean()), np.sqrt(np.diagonal(np.asarray(posterior.cov())))
    contraction, space = np.asarray(posterior.contraction()), env.space
    console.table(
        [
            {
                "name": name, "unit": space.units[i], "low": space.low[i], "high": space.high[i], "mean": mean[i],
                "sd": sd[i], "truth": None if truth is None else truth[i], "contraction": contraction[i],
            }
            for i, name in enumerate(space.names)
        ]
    )  # fmt: skip


def _adapt(argv: Sequence[str] | None) -> int:
    """The outer loop; exit code 0, 2 (bad input) or 130 (Ctrl-C, after a checkpoint)."""
    argv = list(sys.argv[1:] if argv is None else argv)
    args = cli.Parser("main", DESCRIPTION, resume=True).parse(argv)
    if args.list_tasks:
        return cli.list_tasks()
    config, run = _prepare(args)
    from bayessim_mjx.monitor.console import Console

    with Console(headless=args.headless) as console:
        return _run(config, run, ["python", "-m", "bayessim_mjx.main", *argv], console)


def main(argv: Sequence[str] | None = None) -> int:
    """`bayessim-mjx`: the outer loop, or train or play if that is the first word."""
    argv = list(sys.argv[1:] if argv is None else argv)
    if argv[:1] == ["train"]:
        from bayessim_mjx.train import main as train

        return train(argv[1:])
    if argv[:1] == ["play"]:
        from bayessim_mjx.play import main as play

        return play(argv[1:])
    return cli.command(_adapt)(argv[1:] if argv[:1] == ["main"] else argv)


if __name__ == "__main__":
    sys.exit(main())
