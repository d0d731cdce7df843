"""A source of trajectories that is no simulator, with an analytic posterior, and a loop's inference on it."""

import dataclasses
import types

import jax
import jax.numpy as jnp
import numpy as np

from bayessim_mjx import config, loop
from bayessim_mjx.loop import outer_loop, round_inference, sources
from bayessim_mjx.parameters import Parameter, ParameterSpace

SPACE = ParameterSpace([Parameter("mass", 0.0, -1.0, 1.0), Parameter("unseen", 0.0, -1.0, 1.0)])
NORMAL = ParameterSpace(
    [Parameter(name, 0.0, -2.0, 2.0, prior="gaussian", mean=0.0, sd=0.5) for name in ("mass", "unseen")]
)
NOISE, TRUTH, FITTED = 0.1, np.array([0.3, 0.0], np.float32), 2000
SMALL = [
    f"bayessim.trainTrajs={FITTED}", "bayessim.realTrajs=2", "bayessim.realIters=3", "bayessim.components=2",
    "bayessim.hiddenLayers=[16]", "bayessim.checkTrajs=0", "bayessim.priorShare=0.01", "bayessim.refine=off",
]  # fmt: skip


@dataclasses.dataclass(frozen=True, eq=False)
class Stub:
    """x = mass + N(0, 0.1^2), and a feature that is noise alone."""

    offset: float = 0.0  # of the real noise: something that no parameter explains
    mass: float = 0.3  # of the real one; it need not lie in its range
    quiet: float = 1.0  # noise of the simulations that are fitted: < 1 makes a network that is too sure
    policy_dependent: bool = False
    env: None = None  # no robot that programs are compiled for
    noisy: bool = False  # no other draws of noise are asked for
    truth: np.ndarray = dataclasses.field(default_factory=lambda: TRUTH)
    channels: sources.SummaryInputs = sources.SummaryInputs(1, ("height",), ("push",))

    def simulate(self, key, thetas, policy):
        noise = jax.random.normal(key, (len(thetas), 2))
        noise = noise * jnp.where(jnp.arange(len(thetas)) < FITTED, self.quiet, 1.0)[:, None]
        return jnp.stack([thetas[:, 0] + NOISE * noise[:, 0], noise[:, 1]], axis=1)

    def truth_of(self, keys, count):
        return self.truth

    def real(self, key, first, count, policy):
        x = self.simulate(key, jnp.full((count, 2), self.mass), policy)
        return x + jnp.asarray([0.0, self.offset]), jnp.zeros(count)


def made(*more: str, space: ParameterSpace = SPACE, **source) -> tuple[loop.Loop, loop.LoopState]:
    settings = config.load("Pendulum", overrides=[*SMALL, *more])
    names = ("mean of height", "push at step 0")
    parts = loop.Loop(types.SimpleNamespace(space=space), settings, Stub(**source), 2, names)
    return parts, loop.LoopState(round=jnp.int32(0), train=None, **outer_loop.blank(parts))


def infer(parts: loop.Loop, state: loop.LoopState) -> tuple[loop.LoopState, loop.RoundInfo]:
    info = loop.RoundInfo(
        round=int(state.round), rounds=3, domain=state.domain, posterior=None, truth=TRUTH, returns=np.zeros(1),
        lengths=np.zeros(1), real=None, predictive=None, fit={}, scores={}, seconds={}, warnings=[],
    )  # fmt: skip
    state, found = round_inference.infer(parts, state, None)
    return dataclasses.replace(state, round=state.round + 1), info.with_(found)
