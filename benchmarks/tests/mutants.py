"""One-line faults, put into the code one at a time: do the fast tests notice?

    python benchmarks/tests/mutants.py [--only 6 7 ...] [--json FILE]
    python benchmarks/tests/mutants.py --check    # does every edit still apply?

The first 31 are those of a PPO with which rsl_rl 5.4.2's own suite was tried (it notices 5), at the places where our
code does the same; the others are spread over all that is not PPO (`mutant_faults.py`) and over what fails without a
word (`mutant_faults_silent.py`). Each is an edit of one copy of the checkout; then the tests that can see it run until
the first one fails. An edit that does not apply exactly once is an error, and so are tests that cannot run, that are
all skipped, or that fail without any fault.
"""

import argparse
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from mutant_faults import FAULTS
from mutant_faults_silent import SILENT

ROOT = Path(__file__).resolve().parents[2]
COPIED = ("bayessim_mjx", "tasks", "cfg", "tests", "pyproject.toml")
LOSSES, PPO, RND, SYMMETRY = (f"bayessim_mjx/rl/{name}.py" for name in ("losses", "ppo", "rnd", "symmetry"))
GAE, EPISODES, TRAIN, WORLDS = (f"bayessim_mjx/rl/{name}.py" for name in ("gae", "episodes", "train", "worlds"))
COMMAND = "bayessim_mjx/train.py"
T = "tests/rl/test_"
RESUME = ("tests/commands/test_train_command.py", "-k", "test_train_killed_and_resumed_equals_unkilled and 1")
RESTORED = 'return tree["state"], marked(meta)'


class Stale(SystemExit):
    """An edit that does not apply exactly once."""


@dataclass(frozen=True)
class Mutant:
    number: int
    fault: str
    file: str
    old: str  # stands in the file exactly once
    new: str
    tests: tuple[str, ...]  # arguments of pytest
    peer: bool = False  # rsl_rl's suite notices its own


PPO_MUTANTS = (
    Mutant(1, "lambda dropped from GAE", GAE, "decay = gamma * lam * (1", "decay = gamma * (1", (f"{T}gae.py",), True),
    Mutant(
        2, "value after a time limit not discounted", GAE, "reward + gamma * (1 - terminated)",
        "reward + (gamma + (1 - gamma) * truncated) * (1 - terminated)", (f"{T}gae.py",), True,
    ),
    Mutant(
        3, "advantages not divided by their sd", LOSSES, "return (x - x.mean()) / (x.std() + 1e-8)",
        "return x - x.mean()", (f"{T}losses.py", "-k", "standardised"), True,
    ),
    Mutant(
        4, "mirror loss on the wrong half", SYMMETRY, "means[len(mean) : len(mean) * (1 + copies.value.shape[1])]",
        "means[: len(mean) * copies.value.shape[1]]",
        (f"{T}symmetry.py", "-k", "weighted_and_added"), True,
    ),
    Mutant(
        5, "log-probabilities of mirrored samples zeroed", SYMMETRY,
        "Copies(observation, critic_observation, action, density, value, weight)",
        "Copies(observation, critic_observation, action, 0 * density, value, weight)",
        (f"{T}symmetry.py", "-k", "seen_and_rated"), True,
    ),
    Mutant(
        6, "surrogate: max becomes min", LOSSES, "jnp.maximum(-advantage * ratio", "jnp.minimum(-advantage * ratio",
        (f"{T}losses.py", "-k", "surrogate"),
    ),
    Mutant(
        7, "ratio never clipped", LOSSES, "jnp.clip(ratio, 1 - clip, 1 + clip)", "ratio",
        (f"{T}losses.py", "-k", "surrogate"),
    ),
    Mutant(
        8, "value clip removed", LOSSES, "jnp.maximum(error, (clipped - returns) ** 2).mean()", "error.mean()",
        (f"{T}losses.py", "-k", "value_loss"),
    ),
    Mutant(
        9, "sign of the entropy flipped", LOSSES, "- config.entropy_coef * entropy", "+ config.entropy_coef * entropy",
        (f"{T}losses.py", "-k", "entropy"),
    ),
    Mutant(
        10, "adaptive rate the wrong way round", LOSSES, "RATE_FACTOR = 1.5", "RATE_FACTOR = 1 / 1.5",
        (f"{T}losses.py", "-k", "adaptive"),
    ),
    Mutant(
        11, "rate never given to the optimiser", LOSSES, "flat - rate * direction",
        "flat - config.learning_rate * direction", (f"{T}losses.py", "-k", "rate"),
    ),
    Mutant(
        12, "gradient clipping removed", LOSSES, "gradient, norm = clip_norm(gradient, config.max_grad_norm)",
        "norm = jnp.linalg.norm(gradient)", (f"{T}losses.py", "-k", "clipped"),
    ),
    Mutant(
        13, "critic's loss dropped", LOSSES, "surrogate + config.value_loss_coef * value -",
        "surrogate -", (f"{T}losses.py", "-k", "weighted_sum"),
    ),
    Mutant(
        14, "resumed without the learning rate", COMMAND, RESTORED,
        'return tree["state"].replace(learning_rate=state.learning_rate), marked(meta)', RESUME,
    ),
    Mutant(
        15, "intrinsic reward never added", PPO, "reward + bonus", "reward",
        (f"{T}rnd.py", "-k", "sum_of_both"),
    ),
    Mutant(
        16, "predictor never stepped", RND, "(optax.apply_updates(predictor, change), opt_state)",
        "(predictor, opt_state)", (f"{T}rnd.py", "-k", "predictor_learns"),
    ),
    Mutant(
        17, "resumed without the state of RND", COMMAND, RESTORED,
        'return tree["state"].replace(extensions=state.extensions), marked(meta)', RESUME,
    ),
    Mutant(
        18, "mirror loss never added", LOSSES, "total if term is None else total + term", "total",
        (f"{T}symmetry.py", "-k", "weighted_and_added"),
    ),
    Mutant(
        19, "arguments of KL swapped", LOSSES, "law.kl(batch.mean, old, mean, log_std)",
        "law.kl(mean, log_std, batch.mean, old)", (f"{T}losses.py", "-k", "reported_kl"),
    ),
    Mutant(
        20, "novelty by the L1 norm", RND, "networks.mlp(rnd.predictor, x, act), axis=-1)",
        "networks.mlp(rnd.predictor, x, act), ord=1, axis=-1)", (f"{T}rnd.py", "-k", "euclidean"),
    ),
    Mutant(
        21, "intrinsic weight without dt", RND, "(weight(config, clock) * dt)", "weight(config, clock)",
        (f"{T}rnd.py", "-k", "control_step"),
    ),
    Mutant(
        22, "normaliser of the intrinsic reward skipped", RND, "if config.reward_normalization:", "if False:",
        (f"{T}rnd.py", "-k", "normalisations or spreads"),
    ),
    Mutant(
        23, "normaliser of RND's observations skipped", RND, "if config.state_normalization:", "if False:",
        (f"{T}rnd.py", "-k", "normalisations"),
    ),
    Mutant(
        24, "gradient through the mirrored target", SYMMETRY, "jax.lax.stop_gradient(images(mean, actions))",
        "images(mean, actions)", (f"{T}symmetry.py", "-k", "by_hand"),
    ),
    Mutant(
        25, "discounted novelty without gamma", RND, "total = gamma * carry[0] + now", "total = carry[0] + now",
        (f"{T}rnd.py", "-k", "spreads"),
    ),
    Mutant(
        26, "novelty not divided by its spread", RND, "now / jnp.where(deviation > 0, deviation, 1.0)", "now",
        (f"{T}rnd.py", "-k", "spreads"),
    ),
    Mutant(
        27, "all minibatches the same slice", LOSSES,
        "order[:, : size - size % count].reshape(epochs * count, size // count)",
        "jnp.repeat(order[:, : size // count], count, axis=0)", (f"{T}losses.py", "-k", "minibatches or transition"),
    ),
    Mutant(
        28, "tag Train/mean_reward renamed", EPISODES, '"Train/mean_reward": jnp', '"Train/reward": jnp',
        (f"{T}episodes.py",),
    ),
    Mutant(
        29, "steps per second wrong", TRAIN, "count * config.num_envs * config.num_steps / seconds",
        "count * config.num_envs / seconds", (f"{T}train.py", "-k", "speed"),
    ),
    Mutant(
        30, "losses that are not finite go unnoticed", TRAIN, "if not np.isfinite(", "if False and not np.isfinite(",
        (f"{T}train.py", "-k", "not_finite"),
    ),
    Mutant(
        31, "one device's new episodes taken for those of all", WORLDS, "(EVERYWHERE, SECOND, FIRST, FIRST)",
        "(EVERYWHERE, SECOND, FIRST, EVERYWHERE)", (f"{T}devices.py", "-m", "ci", "-k", "curves"),
    ),
)  # fmt: skip
MUTANTS = (*PPO_MUTANTS, *(Mutant(n, *row) for n, row in enumerate(FAULTS + SILENT, len(PPO_MUTANTS) + 1)))


def mutated(text: str, mutant: Mutant) -> str:
    """`text` with the fault in it; Stale where the edit does not apply exactly once."""
    if (count := text.count(mutant.old)) != 1:
        raise Stale(f"{mutant.number} ({mutant.fault}): {mutant.old!r} stands {count} times in {mutant.file}")
    return text.replace(mutant.old, mutant.new)


def stale(mutants: Sequence[Mutant]) -> list[str]:
    """What is to be said of each edit that does not apply exactly once."""
    found = []
    for mutant in mutants:
        try:
            mutated((ROOT / mutant.file).read_text(), mutant)
        except (Stale, OSError) as error:
            found.append(str(error))
    return found


def copy_of_checkout(folder: Path) -> Path:
    """The package, its tasks and tests in `folder`."""
    skip = shutil.ignore_patterns("__pycache__", ".*")
    for name in COPIED:
        source = ROOT / name
        (shutil.copytree(source, folder / name, ignore=skip) if source.is_dir() else shutil.copy(source, folder))
    return folder


def run_tests(copy: Path, arguments: Sequence[str]) -> tuple[int, str]:
    """(exit code of pytest in the copy, the last lines it printed); compiled programs are kept between calls."""
    environment = {
        "JAX_PLATFORMS": "cpu",
        "JAX_COMPILATION_CACHE_DIR": str(copy / "compiled"),
        **os.environ,
        "PYTHONPATH": os.pathsep.join(filter(None, [str(copy), os.environ.get("PYTHONPATH")])),
        "PYTHONDONTWRITEBYTECODE": "1",
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
    }
    command = [sys.executable, "-m", "pytest", "-q", "-x", "--tb=line", "-p", "no:cacheprovider", *arguments]
    done = subprocess.run(command, cwd=copy, env=environment, capture_output=True, text=True)
    return done.returncode, "\n".join((done.stdout + done.stderr).strip().splitlines()[-4:])


def sound(copy: Path, mutants: Sequence[Mutant]) -> None:
    """SystemExit where the copy is not what is imported, or where its tests fail without any fault."""
    check = [sys.executable, "-c", "import bayessim_mjx; print(bayessim_mjx.__file__)"]
    where = subprocess.run(check, cwd=copy, env={**os.environ, "PYTHONPATH": str(copy)}, capture_output=True, text=True)
    if not where.stdout.startswith(str(copy)):
        raise SystemExit(f"the copy {copy} is not what is imported: {where.stdout or where.stderr}")
    for tests in dict.fromkeys(m.tests for m in mutants):
        code, end = run_tests(copy, tests)
        if code or not ran(end):
            raise SystemExit(f"without a fault, {' '.join(tests)} ends with {code}:\n{end}")


def ran(end: str) -> bool:
    """Whether a test ran and passed, by pytest's last lines: where all are skipped it ends with 0 too."""
    return re.search(r"\b[1-9]\d* passed\b", end) is not None


def outcomes(copy: Path, mutants: Sequence[Mutant]) -> Iterator[dict]:
    """One row per fault; outcome killed, survived or error."""
    for mutant in mutants:
        row = {"number": mutant.number, "fault": mutant.fault, "file": mutant.file, "rsl_rl": mutant.peer}
        start, words = time.perf_counter(), ""
        path = copy / mutant.file
        whole = path.read_text()
        path.write_text(mutated(whole, mutant))
        try:
            code, words = run_tests(copy, mutant.tests)
        finally:
            path.write_text(whole)
        outcome = {0: "survived", 1: "killed"}.get(code, "error")
        by = next((line for line in words.splitlines() if line.startswith("FAILED")), words if code != 1 else "")
        yield {
            **row,
            "outcome": outcome,
            "by": by.removeprefix("FAILED ")[:160],
            "seconds": round(time.perf_counter() - start, 1),
        }


def main() -> int:
    """Print the table; 1 where a fault survives or an edit or a test run fails."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", type=int, nargs="+", metavar="N", help="numbers of faults")
    parser.add_argument("--check", action="store_true", help="only look whether every edit still applies")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the table there too")
    args = parser.parse_args()
    mutants = [m for m in MUTANTS if not args.only or m.number in args.only]
    if lines := stale(mutants):  # before the first minute is spent
        print(*lines, f"{len(lines)} of {len(mutants)} edits do not apply", sep="\n", file=sys.stderr)
        return 1
    if args.check:
        print(f"all {len(mutants)} edits apply")
        return 0
    with tempfile.TemporaryDirectory(prefix="mutants_") as folder:
        copy = copy_of_checkout(Path(folder))
        sound(copy, mutants)
        rows = []
        for row in outcomes(copy, mutants):
            rows.append(row)
            took = f"{row.get('seconds', 0):>6.1f} s"
            print(f"{row['number']:>2}  {row['outcome']:<9}{took}  {row['fault']:<46}{row['by']}", flush=True)
    counts = {outcome: sum(r["outcome"] == outcome for r in rows) for outcome in ("killed", "survived", "error")}
    print(
        f"{counts['killed']} of {len(rows)} killed; "
        + ", ".join(f"{n} {word}" for word, n in counts.items() if word != "killed")
    )
    if args.json:
        args.json.write_text(json.dumps({"counts": counts, "mutants": rows}, indent=1) + "\n")
    return int(counts["survived"] + counts["error"] > 0)


if __name__ == "__main__":
    sys.exit(main())
