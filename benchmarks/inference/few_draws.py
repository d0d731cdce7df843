"""How many independent draws a Gaussian of a refined posterior has to stand on (`inference.mixture_fit.numbers_of`).

    OPENBLAS_NUM_THREADS=1 python benchmarks/inference/few_draws.py --samples 40

Made-up posteriors in the unit cube, of which five coordinates are told and four are not: one Gaussian, a curved valley,
two lumps. As in a refinement, weighted draws come from a wider Student's t; 2000 draws of the posterior judge the
Gaussians that are fitted to them. `lost` are the samples whose 95 % region holds less than .85 of these.
"""

import argparse

import jax.numpy as jnp
import numpy as np
from scipy.stats import multivariate_t, norm

from bayessim_mjx.distributions import Distribution
from bayessim_mjx.inference import mixture_fit
from bayessim_mjx.inference.final_importance_sampling import smoothed
from bayessim_mjx.inference.smc import ess_of
from bayessim_mjx.parameters import Parameter, ParameterSpace

TOLD, FREE, MOST, JUDGES = 5, 4, 8, 2000
LEVELS = (0.5, 0.8, 0.95)
LIMITS = (0, 1, 3, 6)  # draws in each direction; 0: as many Gaussians as held-out draws ask for
SPACE = ParameterSpace([Parameter(f"p{i}", 0.5, 0.0, 1.0) for i in range(TOLD + FREE)])
SHIFT = {"gaussian": 0.0, "valley": 0.0, "lumps": 0.25}


def drawn(kind: str, rng: np.random.Generator, count: int) -> np.ndarray:
    """Draws of the posterior [count, d]."""
    x = 0.5 + 0.06 * rng.normal(size=(count, TOLD))
    if kind == "valley":
        x[:, 1] += 6.0 * (x[:, 0] - 0.5) ** 2
    x[:, 0] += SHIFT[kind] * (rng.uniform(size=count) < 0.3)
    return np.concatenate([x, rng.uniform(size=(count, FREE))], axis=1)


def log_density(kind: str, u: np.ndarray) -> np.ndarray:
    x = u[:, :TOLD].copy()
    if kind == "valley":
        x[:, 1] -= 6.0 * (x[:, 0] - 0.5) ** 2
    others = norm.logpdf(x[:, 1:], 0.5, 0.06).sum(1)
    lumps = np.log(0.7 * norm.pdf(x[:, 0], 0.5, 0.06) + 0.3 * norm.pdf(x[:, 0], 0.5 + SHIFT[kind], 0.06) + 1e-300)
    return np.where(np.all((u > 0) & (u < 1), axis=1), lumps + others, -np.inf)


def proposed(kind: str, rng: np.random.Generator, count: int) -> tuple[np.ndarray, np.ndarray]:
    """(draws of a wider t [n, d] within the cube, weights [n]); at most `count`."""
    own = drawn(kind, rng, 300)[:, :TOLD]
    t = multivariate_t(own.mean(0), 1.44 * np.cov(own.T), df=5, seed=rng)
    told = t.rvs(count)
    u = np.concatenate([told, rng.uniform(size=(count, FREE))], axis=1)
    logs = log_density(kind, u) - t.logpdf(told)
    keep = np.isfinite(logs)
    return u[keep], smoothed(logs[keep])[0]


def judged(kind: str, seed: int, count: int) -> tuple[float, list[tuple[int, float, list[float]]]]:
    """(worth of the draws, for each limit: Gaussians, mean log density and shares held by the regions)."""
    rng = np.random.default_rng(seed)
    u, w = proposed(kind, rng, count)
    judges, found = jnp.asarray(drawn(kind, rng, JUDGES).clip(0, 1), jnp.float32), []
    for limit in LIMITS:
        own = np.random.default_rng([seed, 1])
        q = mixture_fit.in_cube(lambda at, own=own, limit=limit: fitted(own, u[:, at], w, limit), u, ess_of(w), w)
        fit = Distribution.from_unit(SPACE, np.log(q.weights), q.means, np.linalg.cholesky(q.covariances))
        levels = np.asarray(fit.credible_level(judges))
        found.append(
            (len(q.weights), float(fit.log_gain(judges).mean()), [float(np.mean(levels <= p)) for p in LEVELS])
        )
    return ess_of(w), found


def fitted(rng: np.random.Generator, z: np.ndarray, w: np.ndarray, limit: int) -> mixture_fit.Mixture:
    """`mixture_fit.fitted`, whose check asks for `limit` draws a direction."""
    supported, kept = mixture_fit.supported, mixture_fit.numbers_of

    def check(rng: np.random.Generator, z: np.ndarray, w: np.ndarray, k: int) -> mixture_fit.Mixture:
        mixture_fit.numbers_of = lambda d: limit * d
        return supported(rng, z, w, k)

    try:
        mixture_fit.supported = check
        return mixture_fit.fitted(rng, z, w, MOST)
    finally:
        mixture_fit.supported, mixture_fit.numbers_of = supported, kept


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--samples", type=int, default=40)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--draws", type=int, nargs="+", default=[400, 2000])
    args = parser.parse_args()
    print("| posterior | worth | draws a direction | Gaussians | 50 / 80 / 95 % regions hold | lost | nats |")
    print("|---|---|---|---|---|---|---|")
    for kind in SHIFT:
        for count in args.draws:
            runs = [judged(kind, args.first + seed, count) for seed in range(args.samples)]
            worth = np.mean([w for w, _ in runs])
            for k, limit in enumerate(LIMITS):
                parts, nats, held = zip(*(found[k] for _, found in runs), strict=True)
                lost = int(np.sum(np.array(held)[:, 2] < 0.85))
                told = " ".join(f"{x:.2f}" for x in np.mean(held, axis=0))
                print(
                    f"| {kind} | {worth:.0f} | {limit} | {np.mean(parts):.1f} | {told} | {lost} of {len(runs)} ", end=""
                )
                print(f"| {np.mean(nats):.2f} |", flush=True)


if __name__ == "__main__":
    main()
