"""Parts of the outer loop: static ones, the state between rounds (the checkpoint), the report of a round."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any, Literal

import flax.struct
import jax
import numpy as np
from jax import Array

from bayessim_mjx.config import BayesSimConfig, Config
from bayessim_mjx.distributions import Distribution
from bayessim_mjx.env import Env
from bayessim_mjx.inference import InferenceSettings, checks, rounds
from bayessim_mjx.inference.calibration import Report
from bayessim_mjx.inference.misspecification import Misfit
from bayessim_mjx.inference.numbers import NEGLIGIBLE
from bayessim_mjx.inference.product_calibration import Sets
from bayessim_mjx.inference.range_ends import Pile
from bayessim_mjx.keys import branch
from bayessim_mjx.loop.sources import Source
from bayessim_mjx.parameters import ParameterSpace
from bayessim_mjx.parameters.ranged import Ranged
from bayessim_mjx.physics.visuals import collides
from bayessim_mjx.quantities import percent
from bayessim_mjx.rl import Policy, TrainState
from bayessim_mjx.rollout import Trajectory

Begin = Callable[[str], None]  # is called with the name of each part of a round when it begins
UNWATCHED: Begin = lambda part: None  # noqa: E731

# rounds of simulations kept for the fit where the collection policy does not change; source: memory alone
KEPT_ROUNDS = 4


@flax.struct.dataclass
class Moving:
    """Ranges of the next round where they may move, and the simulations that were drawn from them."""

    space: Ranged
    covered: Ranged  # what the simulations kept are draws of the prior over
    rows: Array  # [] int32, simulations kept, the first rows
    next: Array  # [] int32, row at which those of the next round begin, if there is room behind it
    slot: Array  # [] int32, of the last round's among `LoopState.proposals`


@flax.struct.dataclass
class LoopState:
    """All that the next round needs, as arrays: it is the checkpoint."""

    round: Array  # int32, rounds finished
    train: TrainState
    domain: Distribution | None  # what physics is drawn from
    fit: Any  # FitState of the inference network; None for the uniform ablation
    thetas: Array  # [kept rounds * trainTrajs, d] simulated parameters; none where every round uses its own alone
    features: Array  # [capacity, D] and their summaries
    real_features: Array  # [realIters * realTrajs, D], the first round * realTrajs rows are filled
    real_posteriors: Distribution | None  # q(theta | x) of each real trajectory at the time it was seen
    proposal: Distribution | None  # what the next round is simulated from; None: the prior, in all rounds
    proposals: Distribution | None  # what the simulations kept come from, leaves [kept rounds, ...]
    temperature: Array  # [] factor on standard deviations that the last round's posterior was given
    motion: dict[str, Array] | None = None  # measured motion of the real trajectories, where bayessim.refine needs it
    moving: Moving | None = None  # None: all rounds have the ranges of the task
    standing: Distribution | None = None  # the product used last, and what it gained on simulated sets (examination.py)
    standing_gain: Array | None = None  # [] nats
    standing_round: Array | None = None  # [] int32, the round that it comes from, from 1 on; 0: none was judged
    settled: Array | None = None  # [] bool, see `bayessim.untilSettled`; None: all rounds are run

    @property
    def has_moved(self) -> bool:
        """Whether the network so far is that of other ranges."""
        return self.moving is not None and not self.moving.space.same(self.fit.space)


@dataclasses.dataclass
class RoundInfo:
    """Report of a round; numbers on the host."""

    round: int
    rounds: int
    domain: Distribution | None  # what this round trained on
    posterior: Distribution | None  # what it inferred
    truth: np.ndarray | None
    returns: np.ndarray  # [n] on the real side (surrogate) or under the domain (logs)
    lengths: np.ndarray
    real: Trajectory | None  # this round's real trajectories
    predictive: dict[str, np.ndarray] | None  # qpos [n, T+1, nq], qvel: the first one, re-simulated
    fit: dict[str, Any]
    scores: dict[str, float]  # log p(truth), gain over the prior, credible level, contraction per parameter
    seconds: dict[str, float]
    warnings: list[str]
    checks: checks.Checks | None = None  # calibration, misfit, ends of ranges; None: none asked for
    sets: Any = None  # how products of several posteriors did on simulated sets, see inference/product_calibration.py
    refinement: Any = None  # what bayessim.refine made of the posterior, see likelihood_refinement.py
    set_posterior: Any = None  # how a network of sets did beside the product, see loop/set_posterior.py
    moves: tuple[Pile, ...] = ()  # ends of ranges at which the posterior piles up, and where they are in the next round
    settled: str = ""  # why no further round is run; "": realIters alone

    def with_(self, found: Evidence) -> RoundInfo:
        """Add the evidence of the round's inference."""
        return dataclasses.replace(
            self,
            **found.fields,
            scores=self.scores | found.scores,
            warnings=[*self.warnings, *found.warnings],
            seconds=self.seconds | found.seconds,
        )


@dataclasses.dataclass(frozen=True)
class Evidence:
    """Findings of one step of a round's inference.

    Attributes:
        fields: of `RoundInfo` that the step fills.
        scores: of the round, by name.
        warnings: sentences for a person.
        seconds: that the step took, by purpose.
        kept: fields of `LoopState` that the next round starts from.
    """

    fields: dict[str, Any] = dataclasses.field(default_factory=dict)
    scores: dict[str, float] = dataclasses.field(default_factory=dict)
    warnings: list[str] = dataclasses.field(default_factory=list)
    seconds: dict[str, float] = dataclasses.field(default_factory=dict)
    kept: dict[str, Any] = dataclasses.field(default_factory=dict)

    def __add__(self, later: Evidence) -> Evidence:
        """Join the evidence of two steps: the later value of a field counts, seconds add up."""
        seconds = {name: self.seconds.get(name, 0.0) + spent for name, spent in later.seconds.items()}
        return Evidence(
            self.fields | later.fields,
            self.scores | later.scores,
            [*self.warnings, *later.warnings],
            self.seconds | seconds,
            self.kept | later.kept,
        )


def chart_of(settings: BayesSimConfig, space: ParameterSpace) -> str:
    """Coordinates in which the loop's domain over `space` is a mixture of Gaussians."""
    if settings.modelClass is None:
        return "plain"
    return rounds.chart_of(InferenceSettings.of(settings).at(space).chart)


@dataclasses.dataclass(frozen=True, eq=False)
class Loop:
    """The parts that do not move."""

    env: Env
    config: Config
    source: Source | None
    feature_size: int
    feature_names: tuple[str, ...] = ()

    @property
    def settings(self) -> BayesSimConfig:
        return self.config.bayessim

    @property
    def capacity(self) -> int:
        """Rows of simulated trajectories kept from round to round; 0: a round's own are fitted and dropped."""
        b = self.settings
        keeps = b.ftune and self.source is not None and not self.source.policy_dependent and b.proposal != "division"
        return b.trainTrajs * min(b.realIters, KEPT_ROUNDS) if keeps else 0

    @property
    def moves(self) -> bool:
        """Whether ranges may move from round to round."""
        return self.settings.range_ends == "move" and self.settings.modelClass is not None

    @property
    def space(self) -> ParameterSpace:
        """Parameters with the ranges of the first round."""
        return Ranged(self.env.space) if self.moves else self.env.space

    @property
    def sequential(self) -> bool:
        """Whether later rounds are simulated from the posterior."""
        return self.settings.modelClass is not None and self.settings.proposal != "prior"

    @property
    def refines(self) -> bool:
        """Whether posteriors are refined by replays of the real trajectories."""
        physics, asked = getattr(self.env, "physics", None), self.settings.refine
        if physics is None or self.settings.modelClass is None:
            return False
        return asked == "likelihood" or (asked == "auto" and not collides(physics.mj_model))

    @property
    def chart(self) -> str:
        """Coordinates in which the domain is a mixture of Gaussians."""
        return chart_of(self.settings, self.env.space)

    def finished(self, state: LoopState) -> bool:
        """Whether no further round is run."""
        return int(state.round) >= self.settings.realIters or bool(state.settled)

    def settled(self, before: Distribution | None, after: Distribution | None) -> str:
        """Say that a posterior is the one before, which its round trained on; "" where it is not."""
        assert before is not None and after is not None
        change = after.estimates().apart(before.estimates())
        if not change <= NEGLIGIBLE:
            return ""
        return (
            f"settled: no median and no end of a 68 % interval has moved by more than {percent(change)} of the prior's "
            "standard deviation; another round would train on the same physics (bayessim.untilSettled)"
        )

    def key(self, round_: int, purpose: str) -> Array:
        """Every random draw has its own key, a function of the seed alone: a resumed run draws the same."""
        purposes = ("init", "train", "evaluate", "simulate", "fit", "real", "predict")
        return branch(jax.random.PRNGKey(self.config.seed), round_ * len(purposes) + purposes.index(purpose))


@dataclasses.dataclass(frozen=True)
class Learnt:
    """Results of training and checking a round's network."""

    fit: dict[str, Any]  # numbers of the training
    known_before: np.ndarray  # [d] bool, parameters that the last round's network identified
    verdict: tuple[Report, Misfit] | None  # calibration and misfit; None: not tested


@dataclasses.dataclass(frozen=True, eq=False)
class Situation:
    """A round once its network is trained."""

    loop: Loop
    state: LoopState  # with the round's network, its temperature and all real trajectories so far
    policy: Policy

    @property
    def number(self) -> int:
        """Rounds before this one."""
        return int(self.state.round)

    @property
    def known(self) -> int:
        """Real trajectories so far, with those of this round."""
        return (self.number + 1) * self.loop.settings.realTrajs


@dataclasses.dataclass(frozen=True, eq=False)
class Round(Situation):
    """Inputs of a correction of the posterior."""

    real: Trajectory  # this round's
    learnt: Learnt
    begin: Begin = UNWATCHED


@dataclasses.dataclass(frozen=True)
class Answer:
    """A posterior of all real trajectories so far."""

    posterior: Distribution
    source: Literal["product", "last round", "replays", "set network"] = "product"
    sets: Sets | None = None  # how products of as many posteriors did on simulated sets; None: not judged


def space_of(loop: Loop, state: LoopState) -> ParameterSpace:
    """Return the parameters, with the ranges of the round that comes."""
    return loop.env.space if state.moving is None else state.moving.space


def slot_of(loop: Loop, state: LoopState, done: int) -> int:
    """Find the slot of the last of `done` rounds among the kept proposals and simulations."""
    return (
        (done - 1) % max(1, loop.capacity // loop.settings.trainTrajs)
        if state.moving is None
        else int(state.moving.slot)
    )


def domain_or_prior(space: ParameterSpace, components: int, chart: str = "plain") -> Distribution | None:
    """Make the prior as a distribution with room for `components` Gaussians; None for a task without parameters."""
    return Distribution.prior(space, components, chart) if len(space) else None
