"""`python -m bayessim_mjx.calibrate --run RUN`: how far the posterior of a finished run can be trusted."""

from __future__ import annotations

import argparse
import dataclasses
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from bayessim_mjx import cli
from bayessim_mjx.config import Config
from bayessim_mjx.device import setup_jax
from bayessim_mjx.errors import UserError

FOLDER = "calibration"


def _parser() -> cli.PlainParser:
    parser = cli.PlainParser(
        prog="python -m bayessim_mjx.calibrate",
        description="Calibration of a run's posterior on fresh simulations, and whether reality looks like them.",
        allow_abbrev=False,
    )
    parser.add_argument("--run", metavar="RUN", required=True, help="folder of the run")
    parser.add_argument("--checkpoint", default="latest", help="latest, best or a step")
    parser.add_argument("--pairs", type=int, default=1000, help="fresh simulated trajectories (1000)")
    parser.add_argument("--seed", type=int, default=0, help="of the fresh simulations")
    parser.add_argument("--device", help="auto, cpu, gpu")
    parser.add_argument("--cache_dir", help="compilation cache; off: none")
    return parser


def _settings(args: argparse.Namespace) -> tuple[Config, Any]:
    from bayessim_mjx.runs import Run

    if args.pairs < 40:
        raise UserError(f"--pairs {args.pairs}: at least 40")
    run = Run.open(args.run)
    top = {key: getattr(args, key) for key in ("device", "cache_dir") if getattr(args, key) is not None}
    config = dataclasses.replace(run.config, **top)
    if config.bayessim.modelClass is None:
        raise UserError(f"--run {args.run}: bayessim.modelClass=None, the run inferred nothing")
    return config, run


def _calibrate(argv: Sequence[str] | None) -> int:
    args = _parser().parse_args(argv)
    config, run = _settings(args)
    setup_jax(config)
    from bayessim_mjx import loop, registry
    from bayessim_mjx.monitor.console import Console

    parts = loop.make(config, registry.make(config.task, config=config))
    tree, _ = run.restore(args.checkpoint, loop.tree_of(parts, loop.init(parts)))
    if int(tree["state"].round) < 1:
        raise UserError(f"--run {args.run}: no round of it is finished, there is no posterior yet")
    with Console(headless=True) as console:
        console.say(f"{config.task}, {args.pairs} fresh pairs of parameters and trajectories, {run.path}")
        found = loop.reexamine(parts, tree["state"], tree["policy"], args.pairs, args.seed)
        for line in report_lines(found):
            console.say(line)
        console.say(f"report and picture: {_write(run.path / FOLDER, found)}")
    return 0


def report_lines(found: Any) -> list[str]:
    """What the command prints of inference.checks.Checks."""
    report = found.calibration
    lines = [f"verdict     posterior {report.words}", f"coverage    {report.table()} (nominal: observed, percent)"]
    lines += [f"gain        {report.gain:.2f} nats over the prior, on average"]
    if report.predictive is not None:
        lines += [f"predictive  p = {report.predictive:.2g} that simulation at the posterior reproduces the summaries"]
    lines += ["", f"{'parameter':<36}{'p of ranks':>12}{'bias [se]':>12}{'width [se]':>12}{'contraction':>13}"]
    rows = zip(report.names, report.bias, report.spread, report.contraction, strict=True)
    lines += [f"{n:<36}{report.p[n]:>12.2g}{bias:>12.1f}{spread:>12.1f}{c:>13.2f}" for n, bias, spread, c in rows]
    p = " ".join(f"{value:.2g}" for value in found.misfit.p)
    lines += ["", f"real trajectories: p = {found.misfit.joint:.2g} that simulation produces the like (each: {p})"]
    return lines + [f"warning: {text}" for text in found.warnings()]


def _write(folder: Path, found: Any) -> Path:
    from bayessim_mjx.checkpoints import write_text
    from bayessim_mjx.monitor import trust

    folder.mkdir(exist_ok=True)
    write_text(folder / "report.json", json.dumps(found.to_dict(), indent=1) + "\n")
    trust.calibration(found.calibration).savefig(folder / "calibration.png")
    return folder


main = cli.command(_calibrate)

if __name__ == "__main__":
    sys.exit(main())
