"""SIGKILL at random moments of real runs, each resumed: are all results bit for bit those of an unkilled run?

    python benchmarks/tests/kills.py [--kills 50] [--seed 0] [--commands train main refine] [--out DIR]

One run of each command is left alone. Then runs are killed, resumed, killed again (up to eight times each) and left to
end. One kill in five falls anywhere in the process (its start too), the others after a random number of checkpoints.
Compared are the checksums of every array in every checkpoint, the evaluations, "latest" and "best", each round's line
in rounds.jsonl (without its seconds), and that no TensorBoard event is there twice. Bit for bit is a matter of one CPU.
`refine` is main with rounds that are mostly refinement; it is killed at any time of its work, by SIGABRT, after which
Python's fault handler tells where it was.
"""

import argparse
import collections
import json
import os
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

TINY = [
    "--headless", "--device=cpu", "env.episodeLength=8", "ppo.num_envs=4", "ppo.num_steps=4", "ppo.num_epochs=2",
    "ppo.num_minibatches=1", "ppo.hidden_actor=[4]", "ppo.hidden_critic=[4]", "ppo.log_interval=1",
    "ppo.save_interval=2", "ppo.eval_episodes=4",
]  # fmt: skip
COMMANDS = {
    "train": ["--randomize", "--max_iterations=40"],
    "main": [
        "--max_iterations=4", "bayessim.realIters=3", "bayessim.trainTrajs=64", "bayessim.realEvals=4",
        "bayessim.components=2", "bayessim.hiddenLayers=[8]", "bayessim.trainTrajLen=4",
        "monitor.posterior_plots=False",
    ],
    "refine": [
        "--max_iterations=2", "bayessim.realIters=2", "bayessim.realTrajs=2", "bayessim.trainTrajs=64",
        "bayessim.realEvals=4", "bayessim.components=2", "bayessim.hiddenLayers=[8]", "bayessim.ensemble=1",
        "bayessim.trainTrajLen=30", "bayessim.checkTrajs=0", "bayessim.refine=likelihood", "real.noise=0.02",
        "bayessim.collectPolicy=policy_random", "monitor.posterior_plots=False",
    ],
}  # fmt: skip
MODULES = {"refine": "main"}  # of those commands that have another name
# files of a process that is refining a posterior
REFINING = ("loop/likelihood", "inference/importance", "inference/smc", "tracking")
MOST = 8  # kills of one run
MOST_SAVES = 4  # that a process lives to see
NEXT_SAVE = 0.6  # s after one, in which the next one is begun
PATIENCE = 600  # s, of a process


@dataclass
class Victim:
    """A run of one command in a folder of its own, through as many processes as it takes."""

    command: str
    folder: Path
    cache: Path
    kills: list[str] = field(default_factory=list)  # where in the run each one fell

    def run(self) -> Path | None:
        """Its run folder, once it has a manifest."""
        made = sorted((self.folder / "logs" / "Pendulum").glob("*/run.json"))
        return made[-1].parent if made else None

    def start(self) -> subprocess.Popen:
        run = self.run()
        args = ["--task", "Pendulum", *TINY, *COMMANDS[self.command], "--logdir", "logs"]
        if run is not None:
            args = ["--resume", str(run), "--headless"]
        log = (self.folder / "log.txt").open("ab")
        module = MODULES.get(self.command, self.command)
        command = [sys.executable, "-X", "faulthandler", "-m", f"bayessim_mjx.{module}", *args]
        command.append(f"--cache_dir={self.cache}")
        return subprocess.Popen(command, cwd=self.folder, stdout=log, stderr=log)

    def begun(self, process: subprocess.Popen, before: int) -> float:
        """Seconds until the process works on its run (or has ended)."""
        began = time.perf_counter()
        while process.poll() is None and time.perf_counter() - began < PATIENCE:
            if (run := self.run()) is not None and self.sessions(run) > before:
                break
            time.sleep(0.01)
        return time.perf_counter() - began

    def saved(self, process: subprocess.Popen, count: int) -> None:
        """Wait for that many new checkpoints (or the end)."""
        seen: set[str] = set()
        began = time.perf_counter()
        while len(seen) <= count and process.poll() is None and time.perf_counter() - began < PATIENCE:
            run = self.run()
            seen.add((run / "run.json").read_text().partition('"latest"')[2] if run else "")
            time.sleep(0.005)

    @staticmethod
    def sessions(run: Path) -> int:
        """How many processes have worked on the run."""
        return 1 + len(json.loads((run / "run.json").read_text()).get("resumed", ()))

    def finish(self) -> tuple[float, float]:
        """Let it run to its end: seconds of its start, and of its work."""
        before = 0 if (run := self.run()) is None else self.sessions(run)
        began, process = time.perf_counter(), self.start()
        start = self.begun(process, before)
        code = process.wait(PATIENCE)
        if code:
            raise SystemExit(f"{self.folder}: exit code {code}: {(self.folder / 'log.txt').read_text()[-2000:]}")
        return start, time.perf_counter() - began - start

    def kill(self, rng: np.random.Generator, start: float, work: float) -> bool:
        """Start it and kill it at a random moment; False if it had ended before that."""
        before = 0 if (run := self.run()) is None else self.sessions(run)
        process = self.start()
        if self.command == "refine":
            self.begun(process, before)
            delay = rng.uniform(0.3 * work, work)  # before that it simulates and fits
        elif rng.random() < 0.2:
            delay = rng.uniform(0.0, start + work)
        else:
            self.begun(process, before)
            saves = int(rng.integers(0, MOST_SAVES + 1))  # checkpoints that it may still make
            self.saved(process, saves)
            delay = rng.uniform(0.0, NEXT_SAVE if saves else work / 2)
        try:
            process.wait(delay)
        except subprocess.TimeoutExpired:
            process.send_signal(signal.SIGABRT if self.command == "refine" else signal.SIGKILL)
            process.wait()
            self.kills.append(self.place())
            return True
        return False

    def place(self) -> str:
        """What the kill left behind."""
        run = self.run()
        if run is None:
            return "before there was a run"
        saved = json.loads((run / "run.json").read_text())["latest"]
        halves = [p.name for p in run.glob("checkpoints/*.tmp")]
        told = (self.folder / "log.txt").read_text(errors="replace").rpartition("Fatal Python error: Aborted")
        refining = ", in a refinement" if told[1] and any(place in told[2] for place in REFINING) else ""
        return f"checkpoint {saved}" + (f", half of {halves[0].partition('.')[0]}" if halves else "") + refining

    def results(self) -> dict[str, Any]:
        """All that has to be as if nothing had happened."""
        run = self.run()
        assert run is not None
        manifest = json.loads((run / "run.json").read_text())
        arrays = {
            c["step"]: json.loads((run / c["path"] / "index.json").read_text())["parts"]
            for c in manifest["checkpoints"]
        }
        listed = [{k: v for k, v in c.items() if k != "path"} for c in manifest["checkpoints"]]
        rounds = run / "rounds.jsonl"
        lines = [json.loads(line) for line in rounds.read_text().splitlines()] if rounds.is_file() else []
        return {
            "status": manifest["status"], "latest": manifest["latest"], "best": manifest["best"], "listed": listed,
            "arrays": arrays, "rounds": [_timeless(line) for line in lines], "events": _repeated(run),
        }  # fmt: skip


def _timeless(value: Any) -> Any:
    """Without seconds and speeds, at any depth."""
    if isinstance(value, dict):
        return {
            k: _timeless(v)
            for k, v in value.items()
            if "second" not in k and "time" not in k.lower() and "fps" not in k
        }
    return value


def _repeated(run: Path) -> list:
    """(folder, tag, step) of events that are there more than once."""
    from bayessim_mjx.monitor.writer import event_files, records

    count = collections.Counter(
        (folder.name, value.tag, event.step)
        for folder in (run, *(run / name for name in ("bsim", "rl", "rl_time")))
        for file in event_files(folder)
        for _, event in records(file)
        for value in event.summary.value
    )
    return [key for key, n in count.items() if n > 1]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kills", type=int, default=50)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--commands", nargs="+", default=list(COMMANDS), choices=list(COMMANDS))
    parser.add_argument("--out", type=Path, help="folder of all runs (default: a temporary one)")
    args = parser.parse_args()
    out = (args.out or Path(tempfile.mkdtemp(prefix="kills_"))).absolute()
    os.environ["JAX_PLATFORMS"] = "cpu"
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))  # processes that are aborted leave no image of their memory
    rng, began, kills, different = np.random.default_rng(args.seed), time.perf_counter(), 0, 0
    whole, spans = {}, {}
    for command in args.commands:
        for name in ("cold", "whole"):  # the first fills the compilation cache
            victim = Victim(command, _folder(out / f"{command}_{name}"), out / "cache")
            spans[command] = victim.finish()
        whole[command] = victim.results()
        print(f"{command}: {spans[command][0]:.1f} s until it works, {spans[command][1]:.1f} s of work", flush=True)
    number = 0
    while kills < args.kills:
        command = args.commands[number % len(args.commands)]
        victim = Victim(command, _folder(out / f"{command}_{number}"), out / "cache")
        for _ in range(min(int(rng.integers(1, MOST + 1)), args.kills - kills)):
            if not victim.kill(rng, *spans[command]):
                break
        victim.finish()
        kills, number = kills + len(victim.kills), number + 1
        found, expected = victim.results(), whole[command]
        wrong = [key for key in expected if found[key] != expected[key]]
        different += bool(wrong)
        said = f"DIFFERENT: {', '.join(wrong)}" if wrong else "the same"
        print(f"{command} {number}: {said}; killed at {'; '.join(victim.kills) or 'no time'}", flush=True)
        if not wrong:
            shutil.rmtree(victim.folder)
    print(f"{kills} kills of {number} runs, {different} of them different; {time.perf_counter() - began:.0f} s")
    return 1 if different else 0


def _folder(path: Path) -> Path:
    path.mkdir(parents=True)
    return path


if __name__ == "__main__":
    sys.exit(main())
