"""False alarms by chance: how often the best of all candidates passes where nothing is missing, under noise as it is.

    python benchmarks/diagnosis/blind.py generate --out CASES --kinds null --seeds 1900:1904 --systems pendulum,cartpole
    python benchmarks/diagnosis/chance.py count CASES [--draws 200]   # no diagnosis is run: minutes on one core
    python benchmarks/diagnosis/chance.py disturb CASES --out OTHERS  # the same logs with more noise, for blind.py run

`count` fits the known parameters of a case and screens all candidates. Then it draws residuals of logs without any
missing effect, of four kinds, and counts how often the best candidate passes: by the price per candidate alone, and by
the bootstrap, which sees nothing but these residuals. Seeds below 2000 are for development.
"""

import argparse
import json
import shutil
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from score import wilson

SIZE = 2.5  # of the coloured noise, in noise standard deviations as estimated: above what counts as the noise itself
MEMORY, JITTER, STEPS = 0.06, 0.003, 8.0  # s; s from first to last; encoder steps in noise standard deviations
LEVELS = (0.01, 0.1)  # family-wise


@dataclass(frozen=True, eq=False)
class Rows:
    """What was measured at the rows of the windows: `[W, H, nv]` in rad or m, rad/s or m/s; sigma `[nv]`; dt in s."""

    q: np.ndarray
    v: np.ndarray
    sigma: np.ndarray
    dt: float


Noise = Callable[[Rows, np.random.Generator], np.ndarray]


def coloured(shape: tuple[int, ...], memory: float, rng: np.random.Generator) -> np.ndarray:
    """First-order noise of size 1 along axis 1; memory in rows."""
    keep = np.exp(-1.0 / memory)
    x = rng.normal(size=shape)
    for k in range(1, shape[1]):
        x[:, k] = keep * x[:, k - 1] + np.sqrt(1 - keep**2) * x[:, k]
    return x


def _quantised(rows: Rows, rng: np.random.Generator) -> np.ndarray:
    step = STEPS * rows.sigma
    at = rows.q + step * rng.uniform(size=rows.sigma.shape)
    return step * np.round(at / step) - at


KINDS: dict[str, Noise] = {
    "white": lambda rows, rng: SIZE * rows.sigma * rng.normal(size=rows.q.shape),
    "coloured": lambda rows, rng: SIZE * rows.sigma * coloured(rows.q.shape, MEMORY / rows.dt, rng),
    "jitter": lambda rows, rng: rows.v * JITTER * rng.uniform(-0.5, 0.5, size=(*rows.q.shape[:2], 1)),
    "encoder steps": _quantised,
}


def count(args: argparse.Namespace) -> None:
    """Alarms by kind of noise, of all cases together."""
    alarms: dict[str, list[list[bool]]] = {kind: [] for kind in KINDS}
    for case in sorted(p.parent for p in args.cases.glob("*/truth.json")):
        if json.loads((case / "truth.json").read_text())["effects"]:
            continue
        for kind, found in of_case(case, args.draws).items():
            alarms[kind] += found
            told = ", ".join(f"{np.mean([row[i] for row in found]):.3f}" for i in range(1 + len(LEVELS)))
            print(f"{case.name}, {kind}: {told} of {len(found)}", flush=True)
    print(f"{'noise':16}{'price alone':>24}", *(f"{f'bootstrap, {100 * level:g} %':>24}" for level in LEVELS))
    for kind, rows in alarms.items():
        each = [[row[i] for row in rows] for i in range(1 + len(LEVELS))]
        shares = [[100 * share for share in (float(np.mean(x)), *wilson(sum(x), len(x)))] for x in each]
        print(f"{kind:16}", *(f"{f'{a:.1f} % ({low:.1f} to {high:.1f})':>24}" for a, low, high in shares), len(rows))


def of_case(case: Path, draws: int) -> dict[str, list[list[bool]]]:
    """{kind: for each draw, whether the price per candidate alone, and each level of the bootstrap, is passed}."""
    from bayessim_mjx.diagnosis.fitting.robot import robot_of
    from bayessim_mjx.diagnosis.selection.criteria import Criteria
    from bayessim_mjx.diagnosis.selection.models import effective_samples, scored
    from bayessim_mjx.diagnosis.selection.screen import screen
    from bayessim_mjx.diagnosis.selection.tried import Tried
    from bayessim_mjx.diagnosis.setup import prepare
    from bayessim_mjx.logs import read_logs

    robot = robot_of(str(case / "model.xml")).stated([], [])
    setup = prepare(robot, read_logs(str(case / "logs"), robot.mj_model, None))
    fitter = setup.fitter
    (fit,) = fitter.iterate([fitter.begin(fitter.base)], 10, lambda f: range(len(f.coordinates)))
    fit = fitter.refresh(fit)
    tried = Tried()
    tried.fitter, tried.settings, tried.criteria = fitter, setup.settings, Criteria()
    tried.screened = screen(fitter, fit, setup.candidates, setup.settings.screened)
    rows, rng = rows_of(fitter), np.random.default_rng(0)
    price = tried.criteria.nats + float(np.log(len(setup.candidates)))
    out = {}
    for kind, noise in KINDS.items():
        found = []
        for _ in range(draws):
            null = replace(fit, r=left_over(fitter, fit, noise(rows, rng)), weight=np.ones(len(fit.r)))
            tried.base = replace(scored(fitter, null, ()), samples=effective_samples(null, fitter))
            found.append(passes(tried, price, rng))
        out[kind] = found
    return out


def passes(tried: Any, price: float, rng: np.random.Generator) -> list[bool]:
    """Whether the best candidate on these residuals passes the price, and each level of a bootstrap of them."""
    from bayessim_mjx.diagnosis.selection import chance

    columns = chance.columns_of(tried)
    assert columns is not None, "no candidate does anything"
    best = float(chance.gains(columns, columns.r[None]).max())
    odds = chance.probability(chance.best_gains(columns, rng, 100), best)
    return [best > price, *(odds <= level for level in LEVELS)]


def rows_of(fitter: Any) -> Rows:
    """What was measured at the windows' rows."""
    cut = fitter.simulator.windows
    rows = cut.start[:, None] + 1 + np.arange(cut.steps)
    q, v = (np.stack([getattr(cut.logs[n], key)[own] for n, own in zip(cut.log, rows, strict=True)])
            for key in ("qpos", "qvel"))  # fmt: skip
    return Rows(q, v, cut.sigma_q, cut.dt)


def left_over(fitter: Any, fit: Any, error: np.ndarray) -> np.ndarray:
    """`[W, n]` residuals of errors `[W, H, nv]` of the positions, with those of the velocities that follow from them.

    Start states and known parameters take what they can, linearly.
    """
    from bayessim_mjx.diagnosis.fitting.quadratic import eliminate, solve

    both = np.concatenate([error, np.gradient(error, fitter.simulator.windows.dt, axis=1)], 2)
    r = fitter.whiten(both)
    offsets = np.zeros_like(fit.offsets)
    q, starts = eliminate(r, fit.A, fit.B, offsets, fitter.spread)
    g, S = q.weighted(np.ones(len(r)))
    precision, _, low, high = fit.prior()
    p = solve(S + np.diag(precision), g, low, high)
    return r - fit.A @ p - np.einsum("wns,ws->wn", fit.B, starts.step(fit.A, p))


def disturb(args: argparse.Namespace) -> None:
    """Copies of null cases whose position columns have more noise of one kind each."""
    for case in sorted(p.parent for p in args.cases.glob("*_null_*/truth.json")):
        truth = json.loads((case / "truth.json").read_text())
        if truth["velocity"]:  # the command differentiates positions itself where no velocity is logged
            continue
        for kind in args.kinds.split(","):
            out = args.out / f"{case.name.replace('_null_', f'_{kind}_null_')}"
            shutil.copytree(case, out, dirs_exist_ok=True)
            for i, file in enumerate(sorted((out / "logs").glob("*.csv"))):
                _disturbed(file, kind, np.random.default_rng((truth["seed"], i)))
            print(out)


def _disturbed(file: Path, kind: str, rng: np.random.Generator) -> None:
    header = file.read_text().splitlines()[0]
    table, names = np.loadtxt(file, delimiter=",", skiprows=1), header.split(",")
    own = [i for i, name in enumerate(names) if name.startswith("qpos:")]
    q, dt = table[None, :, own], float(np.median(np.diff(table[:, 0])))
    sigma = np.std(np.diff(q, 4, axis=1), axis=(0, 1)) / np.sqrt(70.0)  # what differs from row to row
    rows = Rows(q, np.gradient(q, dt, axis=1), sigma, dt)
    table[:, own] += KINDS[kind](rows, rng)[0]
    np.savetxt(file, table, fmt="%.9g", delimiter=",", header=header, comments="")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(required=True)
    counted = commands.add_parser("count", help="alarms on residuals that are drawn")
    counted.add_argument("cases", type=Path)
    counted.add_argument("--draws", type=int, default=200, help="logs per case and kind of noise")
    counted.set_defaults(does=count)
    more = commands.add_parser("disturb", help="null cases with more noise")
    more.add_argument("cases", type=Path)
    more.add_argument("--out", type=Path, required=True)
    more.add_argument("--kinds", default="coloured,jitter")
    more.set_defaults(does=disturb)
    args = parser.parse_args()
    args.does(args)


if __name__ == "__main__":
    main()
