"""sbi's NPE at its defaults on the same pairs: the peer of benchmarks/inference/posteriors.py."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np
from problems import Problem

DRAWS = 256  # per pair, behind coverage and the mass inside the box
PAIRS = 500  # of the held-out ones that are scored: a flow's draws are slow
SAMPLING = 60.0  # s after which rejection sampling is given up (nearly all mass outside the box)


def peer(
    problem: Problem, seed: int, thetas: Any, x: Any, estimator: str, epochs: int = 2**31 - 1
) -> tuple[dict, Callable, Callable]:
    """Train `mdn`, `maf` or `nsf`; -> row, sampler of (x, n), log score and credible levels of pairs."""
    import torch
    from sbi.inference import NPE
    from sbi.utils import BoxUniform

    torch.manual_seed(seed)
    torch.set_num_threads(1)
    tensor = lambda v: torch.tensor(np.array(v))  # noqa: E731
    low, high = tensor(problem.space.low), tensor(problem.space.high)
    prior: Any = BoxUniform(low, high)
    boxed = problem.name != "gaussian_linear"
    if not boxed:
        prior = torch.distributions.MultivariateNormal(torch.zeros(10), 0.1 * torch.eye(10))
    wall, process = time.perf_counter(), time.process_time()
    trainer = NPE(prior=prior, density_estimator=estimator)
    network = trainer.append_simulations(tensor(thetas), tensor(x)).train(max_num_epochs=epochs)
    posterior = trainer.build_posterior()
    wall, process = time.perf_counter() - wall, time.process_time() - process
    row = {"model": f"sbi {estimator}", "wall s": round(wall, 2), "cpu s": round(process, 2), "epochs": trainer.epoch}

    def sample(x: np.ndarray, n: int) -> np.ndarray:
        more = {"max_sampling_time": SAMPLING, "return_partial_on_timeout": True}
        return posterior.sample((n,), x=tensor(x), show_progress_bars=False, **more).numpy()

    @torch.no_grad()
    def scores(thetas: Any, x: Any) -> tuple[np.ndarray, np.ndarray]:
        truth, seen = tensor(thetas[:PAIRS]), tensor(x[:PAIRS])
        draws = network.sample((DRAWS,), condition=seen)
        inside = torch.all((draws >= low) & (draws <= high), dim=-1) if boxed else torch.ones(draws.shape[:2]) > 0
        there = network.log_prob(draws, condition=seen)
        here = network.log_prob(truth[None], condition=seen)[0]
        count = inside.sum(0).clamp(min=1)
        level = ((there > here[None]) & inside).sum(0) / count
        return (here - torch.log(count / DRAWS)).numpy(), level.numpy()

    return row, sample, scores
