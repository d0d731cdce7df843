"""`bayessim-mjx play --task Pendulum --checkpoint best --video`: returns of a saved policy, and a video.

`--export` writes the policy as an ONNX file instead, `--hub` a folder for a model hub.
"""

from __future__ import annotations

import argparse
import dataclasses
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from bayessim_mjx import cli
from bayessim_mjx.config import Config, freeze, replace
from bayessim_mjx.config.settings import COUNT
from bayessim_mjx.device import setup_jax
from bayessim_mjx.errors import UserError
from bayessim_mjx.quantities import compact, estimate, fixed, power

DESCRIPTION = "Evaluate, film or export a saved policy."
HEADER = ["physics", "return", "median", "lowest", "highest", "episode length"]
KINDS = {
    "nominal": "nominal physics",
    "prior": "physics drawn from the prior",
    "real": "surrogate real",
    "posterior": "physics drawn from the posterior",
}


def _parser() -> cli.Parser:
    without = ("--num_envs", "--max_iterations", "--video_interval", "--logger", "--name", "--resume")
    parser = cli.Parser("play", DESCRIPTION, without=without)
    tests, files = parser.group("evaluation"), parser.group("output")
    tests.add_argument(
        "--episodes",
        metavar="N",
        type=cli.whole(1, COUNT),
        help="episodes for each kind of physics (default: --num_envs, else bayessim.realEvals)",
    )
    # Isaac Lab's; not the setting env.numEnvs, which training's batches are limited by
    tests.add_argument("--num_envs", metavar="N", type=cli.whole(0, COUNT), dest="worlds", help="same as --episodes")
    tests.add_argument("--physics", choices=KINDS, help="evaluate on this kind of physics only (default: all)")
    text = "play the policy of the task that comes with the package (docs/pretrained.md)"
    parser.group("policy").add_argument("--use_pretrained_checkpoint", action="store_true", help=text)
    text = "write the policy as an ONNX file and stop (default: in exported/ of the run)"
    files.add_argument("--export", metavar="FILE", nargs="?", const="", help=text)
    text = "write a folder for a model hub: ONNX file, settings, and a card with the returns"
    files.add_argument("--hub", metavar="FOLDER", help=text)
    return parser


def _settings(args: argparse.Namespace) -> tuple[Config, Path, Any]:
    """Load (settings of the checkpoint's run with flags on top, checkpoint folder, run or None)."""
    if args.task:
        args.task = cli.task_name(args.task)
    if args.use_pretrained_checkpoint:
        return _pretrained_settings(args)
    which = args.checkpoint or "best"
    # of a task's newest run, which lies where flags, files and overrides say
    logdir = cli.config_of(args).logdir if args.task and which in ("best", "latest") else ""
    path, run = cli.find_checkpoint(which, args.task, logdir)
    if run is None:
        return cli.config_of(args), path, None
    args.task = args.task or run.manifest["task"]
    args.cfg_env = args.cfg_env or run.path / "params" / "env.yaml"
    args.cfg_train = args.cfg_train or run.path / "params" / "train.yaml"
    return cli.config_of(args), path, run


def _pretrained_settings(args: argparse.Namespace) -> tuple[Config, Path, None]:
    """Load the same for the policy that comes with the package; its videos and exports go beside the folder."""
    from bayessim_mjx.rl import pretrained

    flag, have = "--use_pretrained_checkpoint", ", ".join(pretrained.names())
    if args.checkpoint:
        raise UserError(f"{flag} and --checkpoint {args.checkpoint}: give one of them")
    if not args.task:
        raise UserError(f"{flag}: give --task NAME; policies come for {have}")
    if args.task not in pretrained.names():
        raise UserError(
            f"{flag}: none comes for {args.task}; policies come for {have}. bayessim-mjx train --task {args.task} "
            "makes one, and --checkpoint best plays it"
        )
    for given in [*(["--cfg_train"] if args.cfg_train else []), *args.overrides]:
        if given.startswith(("ppo.", "--cfg_train")):
            raise UserError(f"{given}: the policy that comes with the package has settings of its own; leave it out")
    config = cli.config_of(args)
    return config, Path(config.logdir) / config.task / "pretrained", None


def _nominal(env: Any, count: int) -> Any:
    import jax.numpy as jnp

    return jnp.tile(jnp.asarray(env.space.nominal, jnp.float32), (count, 1))


def _physics(config: Config, env: Any, checkpoint: Path | None, key: Any, count: int) -> dict[str, Callable[[], Any]]:
    """Functions that draw theta [count, d] of every kind of physics; a posterior comes with a `checkpoint`."""
    from bayessim_mjx.distributions import Distribution
    from bayessim_mjx.loop.sources import make_source
    from bayessim_mjx.wrappers.worlds import posterior_of

    kinds: dict[str, Callable[[], Any]] = {"nominal": lambda: _nominal(env, count)}
    if not len(env.space):
        return kinds
    prior = Distribution.prior(env.space, config.bayessim.components)
    kinds["prior"] = lambda: prior.sample(key, count)
    if config.env.realParams is not None and not config.real.logs:
        kinds["real"] = lambda: make_source(config, env).sample(key, count)  # type: ignore[union-attr]
    if checkpoint is not None and (domain := posterior_of(env, checkpoint, config)) is not None:
        kinds["posterior"] = lambda: domain.sample(key, count)
    return kinds


def _video(config: Config, env: Any, policy: Any, physics: tuple[str, Any], key: Any, path: Path) -> str:
    """Film one episode at theta [d] of `physics` (its kind, theta); what to say of it."""
    import numpy as np

    from bayessim_mjx.monitor import film, video
    from bayessim_mjx.monitor.tables import without_prefix

    if not hasattr(env, "physics"):
        raise UserError(f"--video: {env.name} has no MuJoCo model of ours to draw; leave it out")
    kind, theta = physics
    shown = film.motion(env, policy, key, theta, config.monitor.video_length)
    values = [compact(value, 3) for value in np.asarray(theta)]
    about = dict(zip(without_prefix(env.space.names), values, strict=True))
    path.parent.mkdir(parents=True, exist_ok=True)
    title = f"{config.task}, {KINDS[kind]}"
    made = film.frames(video.model_at(env, theta), shown, config.monitor, title, about, path)
    return f"video: {path}" if made is not None else "no video could be made here"


def _export(env: Any, policy: Any, checkpoint: Path, run: Any, target: str, whose: str) -> str:
    """Write the ONNX file; what to say of it. `whose`: of which run and return the policy is."""
    from bayessim_mjx.rl import export

    folder = (run.path if run is not None else checkpoint.parent) / "exported"
    path = Path(target) if target else folder / f"{checkpoint.name}.onnx"
    score = {} if not whose else {"trained": whose}
    error = export.write(path, policy, env, {"checkpoint": checkpoint.name, **score})
    checked = "not compared (onnxruntime is not installed)"
    if error is not None:
        checked = f"its actions differ by {error:.1e} at most from the policy's"
    return f"exported {path}: {checked}{f'; {whose}' if whose else ''}"


def _hub(args: argparse.Namespace, env: Any, policy: Any, config: Config, run: Any, returns: dict[str, Any]) -> str:
    """Write the folder for a model hub; what to say of it."""
    from bayessim_mjx.rl import hub, pretrained

    trained = config if run is None else run.config
    command = "" if run is None else run.manifest["command"]
    if args.use_pretrained_checkpoint:
        command = pretrained.about(config.task)["command"]
    hub.write(Path(args.hub), policy, env, trained, {KINDS[kind]: r for kind, r in returns.items()}, command)
    return f"for a model hub: {args.hub} ({', '.join(hub.OWN)})"


def _play(argv: Sequence[str] | None) -> int:
    args = _parser().parse(argv)
    if args.list_tasks:
        return cli.list_tasks()
    if args.hub and args.export is not None:
        raise UserError("--hub and --export: give one of them; --hub writes the ONNX file too")
    if args.hub:
        cli.writable(args.hub, "--hub")
    if args.export:
        if not args.export.endswith(".onnx"):
            raise UserError(f"--export {args.export}: the file's name has to end with .onnx")
        cli.writable(Path(args.export).parent, "--export")
    config, path, run = _settings(args)
    count = args.episodes or args.worlds or config.bayessim.realEvals
    from bayessim_mjx.monitor.console import Console

    with Console(headless=True) as console:
        return _show(args, config, path, run, count, console)


def _acted_in(config: Config, run: Any) -> Any:
    """Wrap the environment as the policy of `run` sees it."""
    from bayessim_mjx import registry

    return cli.privileged(replace(config, ppo={"teacher": None}), registry.make(config.task, config=config), run)[0]


def returns_table(rows: Sequence[tuple[str, Any, Any]]) -> list[list[str]]:
    """Table of (physics, returns, lengths of episodes): returns to one digit, so that they can be compared.

    The median stands beside the mean: a few bad episodes pull the mean, and its sd passes the best return.
    """
    import numpy as np

    every = np.abs(np.concatenate([np.ravel(r) for _, r, _ in rows]))
    places = max(0, 3 - power(float(every[np.isfinite(every)].max(initial=0.0))))  # four digits of the largest

    def cells(r: Any) -> list[str]:
        return [fixed(float(x), places) for x in (np.median(r), r.min(), r.max())]

    return [[name, estimate(r.mean(), r.std()), *cells(r), compact(length.mean())] for name, r, length in rows]


def _policy(args: argparse.Namespace, config: Config, path: Path, env: Any) -> Any:
    """Load the policy of the checkpoint, or that which comes with the package."""
    if not args.use_pretrained_checkpoint:
        return cli.load_policy(path, env, config)
    from bayessim_mjx.rl import groups, pretrained

    policy, shown = pretrained.pretrained(config.task), groups.size_of(env, "policy")
    if (sees := policy.normalizer.mean.size) != shown:
        raise UserError(
            f"--use_pretrained_checkpoint: the policy observes {sees} numbers, and {config.task} under these settings "
            f"shows {shown}; leave the settings out"
        )
    return policy


def _searched(args: argparse.Namespace, config: Config) -> str:
    """Return the folder in which latest or best was looked for; "" where a path was given."""
    return config.logdir if args.checkpoint in (None, "best", "latest") else ""


def _show(args: argparse.Namespace, config: Config, path: Path, run: Any, count: int, console: Any) -> int:
    """Show the table of returns, and the video."""
    setup_jax(config)
    import jax

    from bayessim_mjx import rl
    from bayessim_mjx.keys import branch

    # also a policy trained on nominal physics can be tried on the prior and on the surrogate real
    trained = config
    config = dataclasses.replace(config, randomization=freeze({**config.randomization, "randomize": True}))
    env = plain = _acted_in(config, run)
    policy, key = _policy(args, config, path, env), jax.random.PRNGKey(config.seed)
    whose = "" if args.use_pretrained_checkpoint else cli.origin(path, run, _searched(args, trained))
    if args.export is not None:
        console.say(_export(env, policy, path, run, args.export, whose))
        return 0
    kinds = _physics(config, env, None if args.use_pretrained_checkpoint else path, key, count)
    if trained.randomization.get("randomize") is False and getattr(env, "nuisance", None):
        plain = _acted_in(trained, run)  # nominal physics is then without the noise that comes with randomisation
        kinds["nominal"] = lambda: _nominal(plain, count)
    if args.physics and args.physics not in kinds:
        raise UserError(f"--physics {args.physics}: this checkpoint and task have {', '.join(kinds)}")
    shown = f"checkpoint {path}{f' ({whose})' if whose else ''}"
    shown = "the policy that comes with the package" if args.use_pretrained_checkpoint else shown
    console.say(f"{config.task}, {count} episodes each, {shown}")
    chosen, rows = {name: kinds[name]() for name in kinds if args.physics in (None, name)}, []
    returns = {}
    for name, thetas in chosen.items():
        console.say(f"evaluating on {KINDS[name]} ...")
        result = rl.evaluate(plain if name == "nominal" else env, policy, branch(key, 1), thetas)
        r, length = result["return"], result["length"]
        returns[name] = r
        rows.append((name, r, length))
    console.grid(HEADER, returns_table(rows))
    if args.hub:
        said = _hub(args, env, policy, config, run, returns)
        console.say(f"{said}{f'; {whose}' if whose else ''}")
    if config.monitor.video:
        name = next(n for n in ("real", "posterior", "prior", "nominal") if n in chosen)
        console.say(f"filming an episode on {KINDS[name]} ...")
        folder = (run.path if run is not None else path.parent) / "videos" / "play"
        shown = plain if name == "nominal" else env
        console.say(_video(config, shown, policy, (name, chosen[name][0]), key, folder / f"{path.name}_{name}.mp4"))
    return 0


main = cli.command(_play)

if __name__ == "__main__":
    sys.exit(main())
