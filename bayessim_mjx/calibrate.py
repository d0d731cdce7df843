"""`bayessim-mjx calibrate --run RUN`: how far the posterior of a finished run can be trusted."""

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
from bayessim_mjx.config.settings import COUNT, SEEDS
from bayessim_mjx.device import setup_jax
from bayessim_mjx.errors import UserError
from bayessim_mjx.quantities import estimate, fixed, percent, percent_estimate

FOLDER = "calibration"
LEVELS = (0.5, 0.8, 0.95)  # regions of posteriors of several trajectories
ADVICE = {
    "calibrated": "its regions contain the truth as often as they should",
    "over-confident": "do not trust its width; raise bayessim.trainTrajs or bayessim.ensemble",
    "under-confident": "the truth lies inside, but the data say more; train longer or raise bayessim.trainTrajs",
    "biased": "do not trust its location; raise bayessim.trainTrajs",
    "miscalibrated": "do not trust its shape; raise bayessim.components or change bayessim.coordinates",
}


def _parser() -> cli.PlainParser:
    about = "Test a finished run's posterior on fresh simulations, and compare real motion with them."
    parser = cli.PlainParser("calibrate", description=about, usage="%(prog)s --run RUN [options]")
    tests, computing = parser.group("test"), parser.group("computing")
    tests.add_argument("--run", metavar="RUN", required=True, help="folder of the run")
    tests.add_argument("--checkpoint", metavar="WHICH", default="latest", help="latest, best or a step number")
    text = "number of fresh simulated trajectories"
    tests.add_argument("--pairs", metavar="N", type=cli.whole(-COUNT, COUNT), default=1000, help=text)
    tests.add_argument("--seed", metavar="N", type=cli.whole(0, SEEDS), default=0, help="random seed")
    parser.trusting("test")
    computing.add_argument("--device", metavar="NAME", help="auto, cpu or gpu (default: that of the run)")
    text = "folder of compiled programs, or off (default: $BAYESSIM_MJX_CACHE, else ~/.cache/bayessim_mjx)"
    computing.add_argument("--cache_dir", metavar="DIR", help=text)
    return parser


def _settings(args: argparse.Namespace) -> tuple[Config, Any]:
    if args.pairs < 40:
        raise UserError(f"--pairs {args.pairs}: at least 40")
    run = cli.open_run(args.run, "--run")
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
    tree, _ = run.restore(args.checkpoint, loop.tree_of(parts, loop.init(parts, trains=False, progress=False)))
    if int(tree["state"].round) < 1:
        raise UserError(f"--run {args.run}: no round of it is finished, there is no posterior yet")
    with Console(headless=True) as console:
        done = int(tree["state"].round)
        console.say(f"{config.task}, round {done}, {args.pairs} fresh pairs of parameters and trajectories, {run.path}")
        found = loop.reexamine(parts, tree["state"], tree["policy"], args.pairs, args.seed)
        show(console, found)
        if text := loop.reused_posterior(tree["state"]):
            console.warning(text)
        folder = write(run.path / FOLDER, found, done)
        console.say(f"report and picture: {folder}, and in TensorBoard under {FOLDER}")
    return 0


def show(console: Any, found: Any) -> None:
    """Verdict, tables and advice of inference.checks.Checks on the terminal."""
    report = found.calibration
    for line in verdict_lines(found):
        console.say(line, indent=12)
    rows = [[percent(a), percent_estimate(c, e)] for a, (c, e) in report.coverage.items()]
    console.grid(["region of the posterior", "truths inside"], rows)
    columns = zip(report.names, report.bias, report.spread, report.contraction, strict=True)
    rows = [[n, f"{report.p[n]:.2g}", fixed(bias, 1), fixed(wide, 1), fixed(c, 2)] for n, bias, wide, c in columns]
    console.grid(["parameter", "p of ranks", "bias [se]", "too narrow [se]", "contraction"], rows)
    if found.sets is not None:
        console.grid(["trajectories", "widened", "gain [nats]", "50 %", "80 %", "95 %"], set_rows(found.sets))
    for text in found.warnings():
        console.warning(text)


def set_rows(sets: Any) -> list[list[str]]:
    """Rows of the table of `product_calibration.Sets`: numbers of trajectories and shares of truths in the regions."""
    rows = []
    for near, c in [(False, c) for c in sets.counts] + [(True, c) for c in sets.near]:
        shares = [percent_estimate(c.coverage(a), (a * (1 - a) / len(c.levels)) ** 0.5) for a in LEVELS]
        where = f"{c.trajectories}, where the posterior lies" if near else str(c.trajectories)
        rows.append([where, f"{c.widening:.2f} x", estimate(c.gain, c.error), *shares])
    return rows


def verdict_lines(found: Any) -> list[str]:
    """State the verdicts in words: on the network, and on whether reality looks like simulation."""
    report, misfit = found.calibration, found.misfit
    lines = [f"verdict     posterior {report.words}: {ADVICE[report.verdict]}"]
    if report.temperature is not None and report.before is None:
        lines += [f"            (tested with its standard deviations times {report.temperature:.2f}, as in its round)"]
    lines += [f"gain        {report.gain:.2f} nats over the prior, on average"]
    if report.predictive is not None:
        lines += [f"predictive  p = {report.predictive:.2g} that simulations at the posterior reproduce the summaries"]
    if found.sets is not None:
        lines += [f"sets        {found.sets.saturation}"]
    each = "" if len(misfit.p) == 1 else f" (each: {' '.join(f'{value:.2g}' for value in misfit.p)})"
    reality = "unlike anything simulated" if misfit.flagged else "like simulated ones"
    return [*lines, f"reality     the real trajectories are {reality}, p = {misfit.joint:.2g}{each}"]


def write(folder: Path, found: Any, round_: int) -> Path:
    """report.json, and the picture as PNG and in TensorBoard at step `round_`, in place of an earlier one."""
    from bayessim_mjx import atomic
    from bayessim_mjx.monitor import plots
    from bayessim_mjx.monitor.writer import TensorBoard

    folder.mkdir(exist_ok=True)
    atomic.write_text(folder / "report.json", json.dumps({"round": round_, **found.to_dict()}, indent=1) + "\n")
    picture = plots.calibration(found.calibration, round=round_, sets=found.sets)
    with TensorBoard(folder, purge_step={"Calibration": round_}, media=folder) as writer:
        writer.figure("Calibration/regions_and_ranks", picture, round_)
        writer.scalars(round_, found.scalars, prefix="Calibration/")
    return folder


main = cli.command(_calibrate)

if __name__ == "__main__":
    sys.exit(main())
