"""All settings with their defaults, meaning and limits, as frozen dataclasses. `loading.py` loads them from files.

The names in `bayessim:`, `env:` and `task:` are BayesSimIG's. Nothing here imports jax.
"""

import dataclasses
import math
import os
import re
import types
import typing
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

from bayessim_mjx import memory
from bayessim_mjx.config.names import model_of, summary_name, summary_of
from bayessim_mjx.errors import UserError

COLLECT_POLICIES = ("policy_random", "policy_ones", "policy_rl", "policy_rl_randomized", "policy_replay")
COORDINATES = ("plain", "matched", "truncated", "probit", "logit", "auto")
PROPOSALS = ("prior", "apt", "truncated", "division")
# (proposal, coordinates)
UNCORRECTED = (("apt", "matched"), ("apt", "truncated"), ("apt", "logit"), ("division", "logit"))
MEMORIES = {"gru": 1, "lstm": 2}  # recurrent layers, and how many numbers each unit remembers
IMPLEMENTATIONS = ("jax", "warp", "auto")  # of MJX
PRECISIONS = ("float32", "bfloat16")
WRITERS = ("jsonl", "csv", "wandb")  # beside TensorBoard
AGENTS = ("own", "sb3", "rsl_rl", "skrl")  # own: bayessim_mjx.rl
ACTIVATIONS = (
    "elu", "relu", "selu", "tanh", "swish", "gelu", "celu", "lrelu", "mish", "softplus", "sigmoid",
)  # fmt: skip
SEEDS = 2**32 - 1  # the largest seed: jax keeps 32 bits of it
COUNT = 10**9  # beyond it a number of steps, episodes or trajectories is a slip of the finger
WIDTH = 10**5  # and of a network's units


class Frozen(dict):
    """A mapping that cannot be changed: sections of free form stay plain dicts to read, and the config immutable."""

    def _refuse(self, *_: Any, **__: Any) -> typing.NoReturn:
        raise TypeError("the configuration is immutable; make another with config.replace or config.load")

    __setitem__ = __delitem__ = update = pop = popitem = clear = setdefault = __ior__ = _refuse  # type: ignore[assignment]

    def __hash__(self) -> int:  # type: ignore[override]
        return hash(tuple(self.items()))

    def __reduce__(self) -> tuple:
        return Frozen, (dict(self),)


def freeze(value: Any) -> Any:
    """Deep copy of plain YAML data with mappings frozen and lists as tuples."""
    if isinstance(value, Mapping):
        return Frozen({str(k): freeze(v) for k, v in value.items()})
    return tuple(freeze(v) for v in value) if isinstance(value, list | tuple) else value


def thaw(value: Any) -> Any:
    """Invert `freeze`: plain dicts and lists, ready for YAML."""
    if isinstance(value, Mapping):
        return {k: thaw(v) for k, v in value.items()}
    return [thaw(v) for v in value] if isinstance(value, list | tuple) else value


def setting(default: Any, doc: str, **limits: Any) -> Any:
    """Declare a field with its meaning and limits (`low`, `high`: inclusive; `above`: exclusive; `choices`).

    Numbers are finite in any case.
    """
    return field(default=default, metadata={"doc": doc, **limits})


class Section:
    """A group of settings; checks its own types and limits however it is made."""

    SECTION: typing.ClassVar[str] = ""
    incompatible_with: typing.ClassVar[Mapping[str, str]] = {}  # settings beside it, and what to say of them

    def __post_init__(self) -> None:
        hints = typing.get_type_hints(type(self))
        for f in dataclasses.fields(self):  # type: ignore[arg-type]
            path = f"{self.SECTION}.{YAML_NAMES.get(f.name, f.name) if not self.SECTION else f.name}".lstrip(".")
            object.__setattr__(self, f.name, checked(getattr(self, f.name), hints[f.name], f.metadata, path))
        self.check()

    def check(self) -> None:
        """Conditions over several settings."""

    def to_dict(self) -> dict[str, Any]:
        """Plain dicts and lists, as written to YAML."""
        values = {f.name: getattr(self, f.name) for f in dataclasses.fields(self)}  # type: ignore[arg-type]
        return {name: v.to_dict() if isinstance(v, Section) else thaw(v) for name, v in values.items()}


def checked(value: Any, annotation: Any, metadata: Mapping[str, Any], path: str, source: str = "") -> Any:
    """`value` with its short form spelt out, of the right type and within the limits; else a UserError."""
    if "spell" in metadata:
        value = metadata["spell"](value)
    value = coerce(value, annotation, path, source)
    check_limits(value, metadata, path, source)
    return value


def _prefixed(prefix: str) -> Callable[[Any], Any]:
    """Short names: `random` for `policy_random`."""
    return lambda value: prefix + value if isinstance(value, str) and not value.startswith(prefix) else value


def number(value: Any) -> float | None:
    """Read a finite number, also one that YAML reads as text (1e-3); None: it is none. Only in the digits 0 to 9."""
    if isinstance(value, bool) or not isinstance(value, int | float | str) or not str(value).isascii():
        return None
    try:
        found = float(value)
    except (ValueError, OverflowError):
        return None
    return found if math.isfinite(found) else None


def _counted(value: Any) -> Any:
    """Read a number where a text is meant."""
    return str(value) if type(value) is int else value


def _absolute(value: Any) -> Any:
    """Make a path, or paths, absolute, so that they mean the same from any folder; the type check refuses non-texts."""
    if isinstance(value, list | tuple):
        return [_absolute(v) for v in value]
    return os.path.abspath(os.path.expanduser(value)) if isinstance(value, str) and value else value


def _weights(widths: tuple[int, ...]) -> float:
    """Bytes of the weights between layers, with Adam's two moments."""
    return 3 * 4.0 * sum(a * b for a, b in zip(widths, widths[1:], strict=False))


def _own_effects(value: Any) -> Any:
    """Effects from files, path.py:MyEffect, by paths that mean the same from any folder."""
    if isinstance(value, list | tuple):
        return [_own_effects(v) for v in value]
    if isinstance(value, Mapping) and ".py:" in str(value.get("effect")):
        return {**value, "effect": _absolute(value["effect"])}
    return value


def _none(value: Any) -> Any:
    """BayesSimIG writes `None` where YAML reads a string."""
    return None if value == "None" else value


def coerce(value: Any, annotation: Any, path: str, source: str = "") -> Any:
    """`value` as the annotated type, or a UserError naming key, value, expected type and `source`."""
    where = f" ({source})" if source else ""
    if isinstance(annotation, types.UnionType) or typing.get_origin(annotation) is typing.Union:
        options = typing.get_args(annotation)
        if value is None and type(None) in options:
            return None
        return coerce(value, next(o for o in options if o is not type(None)), path, source)
    if typing.get_origin(annotation) is tuple:
        item = typing.get_args(annotation)[0]
        value = [value] if isinstance(value, str) and item is str else value
        if not isinstance(value, list | tuple):
            what = {"Frozen": "sections", "int": "whole numbers", "float": "numbers", "str": "texts"}
            raise UserError(f"{path} = {value!r}{where}: expected a list of {what.get(item.__name__, item.__name__)}")
        return tuple(coerce(v, item, f"{path}[{i}]", source) for i, v in enumerate(value))
    if annotation in (Frozen, dict) or (isinstance(annotation, type) and issubclass(annotation, Section)):
        if isinstance(value, Section):
            return value
        if isinstance(value, Mapping):
            return annotation(**value) if issubclass(annotation, Section) else freeze(value)
        raise UserError(f"{path} = {value!r}{where}: expected a section of `key: value` lines")
    if annotation is Any:
        return freeze(value)
    if annotation is float and isinstance(value, int | float) and (found := number(value)) is not None:
        return found
    if annotation is int and isinstance(value, float) and value.is_integer():
        return int(value)
    if annotation is str and isinstance(value, str) and "${" in value:
        raise UserError(f"{path} = {value!r}{where}: ${{...}} is not expanded here; write the text itself")
    if annotation in (bool, str) and isinstance(value, annotation):
        return value
    if annotation is int and isinstance(value, int) and not isinstance(value, bool):
        return value
    name = {"int": "a whole number", "float": "a number", "bool": "True or False", "str": "text"}
    finite = ", and a finite one" if annotation is float and isinstance(value, float) else ""
    raise UserError(f"{path} = {value!r}{where}: expected {name.get(annotation.__name__, annotation.__name__)}{finite}")


def check_limits(value: Any, limits: Mapping[str, Any], path: str, source: str = "") -> None:
    """Raise a UserError where a value (or an item of a tuple) breaks the field's limits."""
    where = f" ({source})" if source else ""
    for item in value if isinstance(value, tuple) else (value,):
        if item is None or isinstance(item, Mapping):
            continue
        if "choices" in limits and item not in limits["choices"]:
            raise UserError(f"{path} = {item!r}{where}: allowed are {', '.join(map(str, limits['choices']))}")
        if "low" in limits and item < limits["low"]:
            raise UserError(f"{path} = {item!r}{where}: must be at least {limits['low']}")
        if "high" in limits and item > limits["high"]:
            raise UserError(f"{path} = {item!r}{where}: must be at most {limits['high']}")
        if "above" in limits and item <= limits["above"]:
            raise UserError(f"{path} = {item!r}{where}: must be greater than {limits['above']}")


def implementation(name: str) -> str:
    """`name`, where it is one of MJX's; UserError else."""
    if name not in IMPLEMENTATIONS:
        raise UserError(f"env.impl = {name!r}: allowed are {', '.join(IMPLEMENTATIONS)}")
    return name


@dataclass(frozen=True)
class EnvConfig(Section):
    """`env:`. Keys of one task only (`options`) are those its cfg/<task>.yaml lists; read like a mapping too."""

    SECTION: typing.ClassVar[str] = "env"
    numEnvs: int = setting(256, "worlds simulated in parallel; the same number as ppo.num_envs", low=1, high=COUNT)
    episodeLength: int | None = setting(None, "control steps per episode; null: the task's own", low=1, high=COUNT)
    realParams: Frozen | None = setting(
        None, "surrogate real: {weights, means, stds}, rows or {name: value}; null: the seed draws"
    )
    impl: str = setting(
        "jax", "what computes the physics: jax, warp (needs warp-lang), or auto", choices=IMPLEMENTATIONS
    )
    unroll: bool = setting(False, "a control step's timesteps in a row in place of a loop: faster, compiles for longer")
    options: Frozen = field(default_factory=Frozen, metadata={"doc": "settings of this task alone"})

    def to_dict(self) -> dict[str, Any]:
        plain = super().to_dict()
        options = plain.pop("options")
        return {**plain, **options}

    def __getitem__(self, key: str) -> Any:
        return self.options[key] if key in self.options else getattr(self, key)

    def get(self, key: str, default: Any = None) -> Any:
        """Return the value of `key`, or `default` where it is absent or null."""
        value = self.options.get(key, getattr(self, key, None))
        return default if value is None else value

    def keys(self) -> list[str]:
        return ["numEnvs", "episodeLength", "realParams", "impl", "unroll", *self.options]

    def __iter__(self) -> Iterator[str]:
        return iter(self.keys())

    def __contains__(self, key: object) -> bool:
        return key in self.keys()


@dataclass(frozen=True)
class BayesSimConfig(Section):
    """`bayessim:`, the keys of BayesSimIG with their meaning there."""

    SECTION: typing.ClassVar[str] = "bayessim"
    trainTrajs: int = setting(10000, "simulated trajectories collected per round", low=10, high=COUNT)
    collectPolicy: str = setting(
        "policy_random", "actions while collecting", choices=COLLECT_POLICIES, spell=_prefixed("policy_")
    )
    summarizerFxn: str = setting(
        "summary_start",
        "trajectory summary: summary_start, _waypts, _corr, _corrdiff, _signatory, _logsignature or _learned; with its "
        "number of steps, waypoints, lags or levels as in summary_corrdiff_3",
        spell=summary_name,
    )
    trainTrajLen: int = setting(
        20, "control steps per training trajectory (arrays have one more row)", low=1, high=COUNT
    )
    ftune: bool = setting(True, "keep one network over all rounds; False: a new one each round")
    modelClass: str | None = setting(
        "MDNN",
        "posterior network: MDNN, MDRFF or MDRFF_<kernel>_<bandwidth>; None: no inference, plain uniform randomisation",
        spell=_none,
    )
    components: int = setting(10, "mixture components", low=1, high=WIDTH)
    fullCovariance: bool = setting(True, "full covariance per component; False: diagonal (BayesSimIG)")
    hiddenLayers: tuple[int, ...] = setting((128, 128), "widths of the network", low=1, high=WIDTH)
    ensemble: int = setting(
        4, "networks trained side by side; their posteriors are averaged by held-out score", low=1, high=50
    )
    coordinates: str = setting(
        "auto",
        "in which the posterior is a Gaussian mixture: plain (in the range, cut off at its ends), matched (so cut off "
        "that the part in the range has the moments that were learnt), truncated (cut off in training too), probit "
        "(the prior is a Gaussian), logit, or auto: probit where every prior is Gaussian, otherwise plain",
        choices=COORDINATES,
    )
    proposal: str = setting(
        "prior",
        "what rounds after the first are simulated from: the prior; or the last posterior, corrected for: apt (in the "
        "loss), truncated (the prior within the posterior's region) or division (BayesSim's, by one Gaussian)",
        choices=PROPOSALS,
    )
    temperature: float | None = setting(
        None,
        "factor on the posterior's standard deviations; null: fitted where a round's tests say over-confident; 1: none",
        above=0,
        high=100,
    )
    lr: float = setting(4e-3, "peak learning rate of the network (cosine; BayesSimIG: 1e-4, constant)", above=0)
    priorShare: float = setting(
        0.05, "prior mixed into each trajectory's posterior: a misjudged one cannot rule out the truth", low=0, high=1
    )
    refine: str = setting(
        "auto",
        "sharpen the posterior by the simulator's own likelihood of the real trajectories, replayed under their "
        "commands: off, likelihood, or auto (where the task has a model to replay them on in which nothing touches)",
        choices=("auto", "off", "likelihood"),
        spell=lambda value: "off" if value is False else value,  # YAML reads a plain off so
    )
    sets: str = setting(
        "product",
        "posterior of several trajectories, where refine does not sharpen it: product (of the posteriors of each), "
        "embedding (a second network that sees them together, trained on sets simulated around the product), or auto "
        "(that of both which does better on simulated sets)",
        choices=("product", "embedding", "auto"),
    )
    noiseDraws: int = setting(
        16,
        "draws of each simulated trajectory's measurement noise, of which training sees another one in every epoch; "
        "fewer where they would need much memory",
        low=1,
        high=1000,
    )
    checkTrajs: int = setting(
        300,
        "fresh simulations a round that test calibration and misfit; 0: no tests (else 40 or more)",
        low=0,
        high=COUNT,
    )
    range_ends: str = setting(
        "report",
        "where the posterior piles up at an end of a parameter's range: report (say so), or move (that end also moves "
        "out for the next round, as far as physics allows)",
        choices=("report", "move"),
    )
    distrust: float = setting(
        0.5, "most of the prior mixed into the randomisation where the real trajectories are unlike simulated ones",
        low=0, high=1,
    )  # fmt: skip
    realEvals: int = setting(100, "surrogate-real episodes that score the policy each round", low=1, high=COUNT)
    realTrajs: int = setting(1, "real trajectories used for inference each round (they accumulate)", low=1, high=COUNT)
    realIters: int = setting(5, "rounds of the outer loop", low=1, high=COUNT)
    untilSettled: bool = setting(
        False,
        "end before realIters after a round that left the posterior as it was: another would train on the same physics",
    )
    ftuneRL: bool = setting(False, "keep training one policy over all rounds; False: a new one each round")
    policyCheckpt: str | None = setting(None, "checkpoint of a policy to start from", spell=_none)

    def check(self) -> None:
        if 0 < self.checkTrajs < 40:
            raise UserError(f"bayessim.checkTrajs = {self.checkTrajs}: 0 (no tests), or at least 40")
        summary_of(self.summarizerFxn, "bayessim.summarizerFxn")
        if (self.proposal, self.coordinates) in UNCORRECTED:
            raise UserError(
                f"bayessim.proposal = {self.proposal!r}: no correction in bayessim.coordinates = {self.coordinates!r}; "
                "take coordinates plain or probit, or proposal truncated or prior"
            )
        if self.modelClass is not None:
            model_of(self.modelClass, "bayessim.modelClass")


@dataclass(frozen=True)
class WeightSchedule(Section):
    """`ppo.rnd.weight_schedule:`. Steps are control steps of all worlds together in time, not iterations."""

    SECTION: typing.ClassVar[str] = "ppo.rnd.weight_schedule"
    mode: str = setting("constant", "course of the weight", choices=("constant", "step", "linear"))
    initial_step: int | None = setting(None, "linear: control step at which the weight begins to move", low=0)
    final_step: int | None = setting(None, "step, linear: control step from which on it is final_value", low=0)
    final_value: float | None = setting(None, "step, linear: last weight, in the units of ppo.rnd.weight", low=0)

    def check(self) -> None:
        needed = {"constant": (), "step": ("final_step", "final_value")}
        for name in needed.get(self.mode, ("initial_step", "final_step", "final_value")):
            if getattr(self, name) is None:
                raise UserError(f"{self.SECTION}.{name} is missing: mode {self.mode} needs it")
        if self.mode == "linear" and self.initial_step >= self.final_step:  # type: ignore[operator]
            raise UserError(
                f"{self.SECTION}.initial_step = {self.initial_step} must be less than final_step = {self.final_step}"
            )


@dataclass(frozen=True)
class RNDConfig(Section):
    """`ppo.rnd:`, random network distillation; the names and defaults of rsl_rl."""

    SECTION: typing.ClassVar[str] = "ppo.rnd"
    incompatible_with: typing.ClassVar[Mapping[str, str]] = {
        "teacher": "a student has no use for ppo.rnd; set one of them to null"
    }
    num_outputs: int = setting(1, "size of the embedding", low=1, high=WIDTH)
    predictor_hidden_dims: tuple[int, ...] = setting(
        (-1,), "widths of the predictor; -1: size of its input", low=-1, high=WIDTH
    )
    target_hidden_dims: tuple[int, ...] = setting(
        (-1,), "widths of the random target; -1: size of its input", low=-1, high=WIDTH
    )
    activation: str = setting("elu", "activation of both networks", choices=ACTIVATIONS)
    state_normalization: bool = setting(False, "running mean and variance of the observations they see")
    reward_normalization: bool = setting(False, "novelty in units of the spread of its discounted sum")
    weight: float = setting(0.0, "weight of the novelty as a reward per second (times the control step)", low=0)
    weight_schedule: WeightSchedule | None = setting(None, "course of the weight; null: constant")
    learning_rate: float = setting(1e-3, "Adam learning rate of the predictor", above=0)
    obs_groups: tuple[str, ...] = setting((), "observation groups they see; none: rnd_state, else policy")

    def check(self) -> None:
        for name in ("predictor_hidden_dims", "target_hidden_dims"):
            if 0 in getattr(self, name):
                raise UserError(f"{self.SECTION}.{name} = {list(getattr(self, name))}: widths are 1 or more, or -1")
        if not self.weight and not (self.weight_schedule and self.weight_schedule.final_value):
            raise UserError(
                f"{self.SECTION}.weight = 0: novelty adds no reward; give a weight above 0, or {self.SECTION}=null"
            )


@dataclass(frozen=True)
class SymmetryConfig(Section):
    """`ppo.symmetry:`, use of the robot's mirror maps; all off: its asymmetry is only logged."""

    SECTION: typing.ClassVar[str] = "ppo.symmetry"
    incompatible_with: typing.ClassVar[Mapping[str, str]] = {
        "teacher": "a student has no use for ppo.symmetry; set one of them to null",
        "critic_theta": "theta has no mirror image, so ppo.symmetry has to be null",
        "policy_theta": "theta has no mirror image, so ppo.symmetry has to be null",
        "memory": "not with ppo.symmetry; set one of them to 0 or null",
        "actor_groups": "mirror maps are of the task's own groups, so ppo.symmetry has to be null",
        "critic_groups": "mirror maps are of the task's own groups, so ppo.symmetry has to be null",
    }
    use_data_augmentation: bool = setting(False, "train on the mirrored samples too")
    use_mirror_loss: bool = setting(False, "add the mirror loss, the squared difference of a(M o) and M a(o)")
    mirror_loss_coeff: float = setting(0.0, "weight of the mirror loss", low=0)

    def check(self) -> None:
        if self.use_mirror_loss and not self.mirror_loss_coeff:
            raise UserError(
                f"{self.SECTION}.use_mirror_loss = True: {self.SECTION}.mirror_loss_coeff = 0 adds no loss; give a "
                "coefficient above 0, as 1"
            )


@dataclass(frozen=True)
class PPOConfig(Section):
    """`ppo:`, also the content of a --cfg_train file."""

    SECTION: typing.ClassVar[str] = "ppo"
    num_envs: int = setting(256, "worlds in parallel; the same number as env.numEnvs", low=1, high=COUNT)
    num_steps: int = setting(16, "control steps per world and iteration", low=1, high=COUNT)
    num_epochs: int = setting(5, "passes over each batch", low=1, high=COUNT)
    num_minibatches: int = setting(4, "minibatches per pass", low=1, high=COUNT)
    gamma: float = setting(0.99, "discount", low=0, high=1)
    gae_lambda: float = setting(0.95, "lambda of the advantage estimate", low=0, high=1)
    clip_param: float = setting(0.2, "clip range of the probability ratio", above=0)
    use_clipped_value_loss: bool = setting(True, "clip the value loss with the same range")
    value_loss_coef: float = setting(1.0, "weight of the value loss", low=0)
    entropy_coef: float = setting(0.0, "weight of the entropy bonus", low=0)
    learning_rate: float = setting(3e-4, "Adam learning rate (at the start, if adaptive)", above=0)
    schedule: str = setting("adaptive", "learning rate by KL, or fixed", choices=("adaptive", "fixed"))
    desired_kl: float = setting(0.01, "KL per update that the adaptive schedule aims at", above=0)
    max_grad_norm: float = setting(1.0, "gradient clipping", above=0)
    normalize_observations: bool = setting(True, "running mean and variance of observations")
    normalize_advantage_per_minibatch: bool = setting(False, "else once per batch")
    reward_scale: float = setting(1.0, "factor on rewards seen by the learner", above=0)
    segment: int = setting(
        0, "minibatches estimate advantages anew over segments of so many steps; 0: no", low=0, high=COUNT
    )
    weight_init: str = setting("orthogonal", "how weights begin", choices=("orthogonal", "lecun_uniform"))
    hidden_actor: tuple[int, ...] = setting((64, 64), "widths of the actor", low=1, high=WIDTH)
    hidden_critic: tuple[int, ...] = setting((64, 64), "widths of the critic", low=1, high=WIDTH)
    activation: str = setting("elu", "activation of both networks", choices=ACTIVATIONS)
    precision: str = setting(
        "float32", "numbers between the layers of both networks: float32 or bfloat16 (weights stay float32)",
        choices=PRECISIONS,
    )  # fmt: skip
    init_std: float = setting(1.0, "initial standard deviation of actions", above=0)
    std_type: str = setting(
        "log",
        "learnt number: the logarithm of the standard deviation, or itself",
        choices=("log", "scalar"),
    )
    std_range: tuple[float, ...] = setting((), "least and greatest standard deviation; none: no limits", above=0)
    distribution: str = setting(
        "gaussian", "of actions: gaussian, or beta on the range +- action_clip (init_std is unused)",
        choices=("gaussian", "beta"),
    )  # fmt: skip
    state_dependent_std: bool = setting(False, "the actor gives the standard deviation too, else it is a parameter")
    shared_trunk: bool = setting(False, "the critic is one layer on the actor's hidden ones (hidden_critic is unused)")
    memory: int = setting(0, "units of a recurrent layer before the actor's others; 0: none", low=0, high=WIDTH)
    memory_layers: int = setting(1, "recurrent layers, one on the other", low=1, high=20)
    gradient_length: int = setting(
        0, "steps that gradients of recurrent layers flow back through; 0: all ppo.num_steps", low=0, high=COUNT
    )
    actor_groups: tuple[str, ...] = setting(
        (), "observation groups that the actor sees, one after the other; none: policy (train, play)"
    )
    critic_groups: tuple[str, ...] = setting(
        (), "observation groups that the critic sees; none: critic where there is one, else the actor's groups"
    )
    memory_cell: str = setting("gru", "kind of the recurrent layer: gru or lstm", choices=tuple(MEMORIES))
    critic_theta: bool = setting(False, "the critic also sees the physics, theta (not the actor)")
    policy_theta: bool = setting(False, "the policy sees theta too: a teacher, for simulation alone (train, play)")
    teacher: str | None = setting(None, "checkpoint of a policy to imitate, in place of PPO (train)", spell=_absolute)
    distil_loss: str = setting("mse", "error of the imitated actions", choices=("mse", "huber"))
    action_clip: float = setting(1.0, "actions are kept within +- this before the environment", above=0)
    action_bound: str = setting("clip", "how: clipped, or squashed by action_clip * tanh", choices=("clip", "tanh"))
    rnd: RNDConfig | None = setting(None, "random network distillation: rewards for novel states; null: none")
    symmetry: SymmetryConfig | None = setting(None, "use of the robot's mirror symmetry; null: none")
    extensions: tuple[typing.Any, ...] = setting(
        (), "extensions of your own: list of {extension: NAME, setting: value, ...}; docs/ppo_extensions.md"
    )
    max_iterations: int = setting(100, "iterations (per round of the outer loop)", low=0, high=COUNT)
    log_interval: int = setting(10, "iterations between log lines", low=1, high=COUNT)
    save_interval: int = setting(50, "iterations between checkpoints", low=1, high=COUNT)
    eval_episodes: int = setting(100, "episodes per evaluation", low=1, high=COUNT)

    def to_dict(self) -> dict[str, Any]:
        """As of every section; an extension that is an object by its name and fields."""
        return {**super().to_dict(), "extensions": [_described(e) for e in self.extensions]}

    @property
    def memory_size(self) -> int:
        """Numbers that the policy carries on from step to step."""
        return MEMORIES[self.memory_cell] * self.memory * self.memory_layers

    def check(self) -> None:
        batch = self.num_envs * self.num_steps
        if self.num_minibatches > batch:
            raise UserError(
                f"ppo.num_minibatches = {self.num_minibatches} is more than the batch of num_envs * num_steps = "
                f"{self.num_envs} * {self.num_steps} = {batch} samples"
            )
        if self.segment:
            self._check_segment()
        if self.shared_trunk and self.critic_theta:
            raise UserError(
                "ppo.critic_theta = True: with ppo.shared_trunk the actor would see theta too; use one of them"
            )
        for section in (self.rnd, self.symmetry):
            refuse_together({} if section is None else section.incompatible_with, self)
        for given in self.extensions:
            object_ = dataclasses.is_dataclass(given) and not isinstance(given, type)
            if not object_ and not (isinstance(given, Mapping) and isinstance(given.get("extension"), str)):
                raise UserError(f"ppo.extensions: {given!r}: expected {{extension: NAME, setting: value, ...}}")
        if self.extensions:
            refuse_together({"teacher": "a student has no use for ppo.extensions; leave one of them out"}, self)
        self._check_spread()
        if self.memory and self.num_minibatches > self.num_envs:
            raise UserError(
                f"ppo.num_minibatches = {self.num_minibatches}: with ppo.memory a minibatch is of whole sequences, and "
                f"there are only num_envs = {self.num_envs}"
            )
        if self.shared_trunk and not self.hidden_actor:
            raise UserError("ppo.shared_trunk = True needs hidden layers to share: ppo.hidden_actor is []")
        if self.state_dependent_std and not 0.007 <= self.init_std <= 148:  # exp(+-5), networks.LOG_STD_LIMIT
            raise UserError(f"ppo.init_std = {self.init_std}: with ppo.state_dependent_std it is from 0.007 to 148")

    def _check_spread(self) -> None:
        """Which settings of the actions' distribution go together."""
        if self.std_range and not (len(self.std_range) == 2 and self.std_range[0] < self.std_range[1]):
            raise UserError(f"ppo.std_range = {list(self.std_range)}: expected [least, greatest], or [] for no limits")
        if self.std_range and not self.std_range[0] <= self.init_std <= self.std_range[1]:
            raise UserError(f"ppo.init_std = {self.init_std} lies outside ppo.std_range = {list(self.std_range)}")
        if self.state_dependent_std and self.std_type != "log":
            raise UserError("ppo.std_type = 'scalar': with ppo.state_dependent_std it is log")
        if self.distribution == "beta":
            given = {
                "state_dependent_std": self.state_dependent_std, "std_range": self.std_range,
                "std_type": self.std_type != "log", "action_bound": self.action_bound != "clip",
            }  # fmt: skip
            for name in (name for name, on in given.items() if on):
                raise UserError(f"ppo.{name} = {getattr(self, name)!r}: not with ppo.distribution=beta, which has none")
        if self.memory_layers > 1 and not self.memory:
            raise UserError(f"ppo.memory_layers = {self.memory_layers}: there is no recurrent layer; set ppo.memory")
        if self.gradient_length and not self.memory:
            raise UserError(
                f"ppo.gradient_length = {self.gradient_length}: there is no recurrent layer; set ppo.memory"
            )

    def _check_segment(self) -> None:
        said = f"ppo.segment = {self.segment}"
        if self.num_steps % self.segment:
            raise UserError(f"{said} has to divide ppo.num_steps = {self.num_steps}")
        if self.num_minibatches > self.num_envs * self.num_steps // self.segment:
            raise UserError(f"{said}: there are fewer segments than ppo.num_minibatches = {self.num_minibatches}")
        if not self.normalize_advantage_per_minibatch:
            raise UserError(f"{said} needs ppo.normalize_advantage_per_minibatch=True: each has advantages of its own")
        if self.memory:
            raise UserError(f"{said}: not with ppo.memory, whose minibatches are of whole sequences; set one to 0")


def _described(extension: Any) -> Any:
    """`{extension: NAME, ...}` of an extension in either of its two forms."""
    if isinstance(extension, Mapping):
        return thaw(extension)
    fields = {f.name: getattr(extension, f.name) for f in dataclasses.fields(extension)}
    return {"extension": extension.name, **thaw(fields)}


def refuse_together(others: Mapping[str, str], config: PPOConfig) -> None:
    """UserError where one of the settings `others` of `ppo:` is on; their values are what to say then."""
    for name, why in others.items():
        value = getattr(config, name)
        if value not in (None, 0, ()):
            shown = "" if isinstance(value, Section) else f" = {value!r}"
            raise UserError(f"ppo.{name}{shown}: {why}")


@dataclass(frozen=True)
class RealConfig(Section):
    """`real:`, logs of the real system in place of the surrogate."""

    SECTION: typing.ClassVar[str] = "real"
    logs: tuple[str, ...] = setting(
        (), "log files or folders, kept as absolute paths; none: the surrogate at env.realParams", spell=_absolute
    )
    map: str | None = setting(None, "YAML file from log columns to joints and actuators", spell=_absolute)
    segment_length: int | None = setting(
        None, "control steps per segment; null: bayessim.trainTrajLen", low=1, high=COUNT
    )
    segment_stride: int | None = setting(
        None, "control steps between segment starts; null: no overlap (what overlaps counts once)", low=1, high=COUNT
    )
    noise: float = setting(
        0.0, "sd of the noise on the surrogate's observations; without effect where real.logs is given", low=0
    )

    def check(self) -> None:
        if self.map is not None and not self.logs:
            raise UserError(f"real.map = {self.map!r}: there are no logs to map; give real.logs too, or leave it out")


@dataclass(frozen=True)
class MonitorConfig(Section):
    """`monitor:`, what is shown and recorded."""

    SECTION: typing.ClassVar[str] = "monitor"
    writers: tuple[str, ...] = setting(
        (), "where figures go beside TensorBoard: jsonl, csv, wandb (needs wandb)", choices=WRITERS
    )
    posterior_plots: bool = setting(True, "picture of the posterior each round")
    video: bool = setting(False, "record videos")
    video_length: int = setting(200, "control steps per video", low=1, high=COUNT)
    video_interval: int = setting(2000, "control steps of each world between videos", low=1, high=COUNT)
    video_width: int = setting(960, "width of a video in pixels; half of it while training", low=64, high=7680)
    video_height: int = setting(720, "height of a video in pixels; half of it while training", low=64, high=7680)


@dataclass(frozen=True)
class Config(Section):
    """All settings of a run. In YAML `task` is called `task_name`, and `randomization` is BayesSimIG's `task:`."""

    task: str = setting("", "name of the task")
    seed: int = setting(0, "seed of everything random", low=0, high=SEEDS)
    name: str = setting("", "last part of the run folder's name")
    logdir: str = setting("logs", "root of the run folders")
    agent: str = setting("own", "whose PPO trains (train alone)", choices=AGENTS)
    domain: str | None = setting(
        None,
        "physics of the episodes (train alone): a run's checkpoint, whose posterior it is, or a file of "
        "Distribution.save; null: the prior if task.randomize",
    )
    device: str = setting("auto", "auto, cpu, gpu, gpu:1, cuda:0")
    devices: str = setting("1", "how many share the worlds of PPO: a number, or all", spell=_counted)
    cache_dir: str | None = setting(None, "compilation cache; null: $BAYESSIM_MJX_CACHE or ~/.cache/bayessim_mjx/jax")
    env: EnvConfig = field(default_factory=EnvConfig)
    randomization: Frozen = field(default_factory=Frozen)
    effects: tuple[Frozen, ...] = setting(
        (),
        "unmodelled effects in the simulator: list of {effect, where, ...}, or an effects.yaml; ranges: "
        "task.randomization_params.effects",
        spell=_own_effects,
    )
    calibrated: tuple[Frozen, ...] = setting((), "the model's parameters as identified, from an effects.yaml")
    bayessim: BayesSimConfig = field(default_factory=BayesSimConfig)
    ppo: PPOConfig = field(default_factory=PPOConfig)
    real: RealConfig = field(default_factory=RealConfig)
    monitor: MonitorConfig = field(default_factory=MonitorConfig)

    def check(self) -> None:
        if not re.fullmatch(r"[\w.-]*", self.name):
            raise UserError(f"name = {self.name!r}: use letters, digits, - _ and . only")
        if self.env.numEnvs != self.ppo.num_envs:
            raise UserError(
                f"env.numEnvs = {self.env.numEnvs} and ppo.num_envs = {self.ppo.num_envs} are one setting: "
                "give the same number, or only one of them"
            )
        memory.refuse(self._needs())

    def _needs(self) -> Iterator[tuple[str, float]]:
        """Lower bounds of the memory that the settings ask for, bytes: what any task would take."""
        ppo, b = self.ppo, self.bayessim
        yield f"ppo.memory = {ppo.memory}", _weights((ppo.memory, 3 * ppo.memory))
        if self.devices == "1":
            steps = f"ppo.num_envs = {ppo.num_envs} (env.numEnvs) worlds, ppo.num_steps = {ppo.num_steps}"
            remembered = f", ppo.memory = {ppo.memory}" if ppo.memory else ""
            yield steps + remembered, 4.0 * ppo.num_envs * (60 + ppo.num_steps * (12 + ppo.memory))
        yield f"ppo.hidden_actor = {list(ppo.hidden_actor)}", _weights(ppo.hidden_actor)
        yield f"ppo.hidden_critic = {list(ppo.hidden_critic)}", _weights(ppo.hidden_critic)
        if b.modelClass is None:
            return
        yield f"bayessim.trainTrajs = {b.trainTrajs}", 4.0 * 10 * b.trainTrajs
        yield f"bayessim.trainTrajLen = {b.trainTrajLen}", 4.0 * 8 * min(b.trainTrajs, 4096) * b.trainTrajLen
        yield f"bayessim.hiddenLayers = {list(b.hiddenLayers)}", b.ensemble * _weights(b.hiddenLayers)
        heads = _weights((*b.hiddenLayers[-1:], 3 * b.components))
        kept = 4.0 * 3 * b.components * b.realIters * b.realTrajs
        yield (
            f"bayessim.components = {b.components} of each of bayessim.realIters * realTrajs = "
            f"{b.realIters} * {b.realTrajs} posteriors",
            b.ensemble * (heads + kept),
        )

    @property
    def task_name(self) -> str:
        """The YAML name of `task`."""
        return self.task

    def to_dict(self) -> dict[str, Any]:
        """Plain nested dicts with the YAML names, fully resolved; `config.from_dict` is the inverse."""
        plain: dict[str, Any] = {}
        for f in dataclasses.fields(self):
            value = getattr(self, f.name)
            plain[YAML_NAMES.get(f.name, f.name)] = value.to_dict() if isinstance(value, Section) else thaw(value)
        return plain


YAML_NAMES = {"task": "task_name", "randomization": "task"}
