"""One case of the blind benchmark in a process of its own: the command, the true effect's closure, the baselines.

    python benchmarks/diagnosis/worker.py CASE --out FOLDER [--baselines] [--verdict-only] [--more ARGUMENTS]

Writes what the command writes, then oracle.json, exit.json (without it the case is not finished), baselines.json. The
command gets nothing but model and logs; the truth is opened after its verdict is on disk.
"""

import argparse
import json
import sys
import time
from pathlib import Path
from typing import Any

COMPILING = "/jax/core/compile/"  # JAX's events: tracing, lowering, compiling (or reading the compilation cache)


def diagnose(arguments: list[str]) -> tuple[int, dict[str, float], Any]:
    """`watched`, with the findings open again for further fits."""
    code, times, found = watched(arguments)
    from baselines import Reopened

    return code, times, Reopened(found) if found else None


def watched(arguments: list[str]) -> tuple[int, dict[str, float], Any]:
    """(exit code, seconds in all and of compilation, findings or None) of the diagnosis's own command."""
    started = time.perf_counter()
    from bayessim_mjx import diagnose as command
    from bayessim_mjx.diagnosis import run
    from bayessim_mjx.diagnosis.findings import Findings

    kept = []
    original = run.investigate
    compiling = compilations()

    def keep(*args: Any, **options: Any) -> Findings:
        kept.append(original(*args, **options))
        return kept[0]

    run.investigate = keep
    code = command.main(arguments)
    times = {"seconds": time.perf_counter() - started, "compile_seconds": covered(compiling)}
    run.investigate = original
    return code, times, kept[0] if kept else None


def compilations() -> list[tuple[float, float]]:
    """A list that takes (first, last second) of each compilation from now on."""
    import jax.monitoring

    spans: list[tuple[float, float]] = []

    def listen(event: str, seconds: float, **_: Any) -> None:
        if event.startswith(COMPILING):
            spans.append((time.perf_counter() - seconds, time.perf_counter()))

    jax.monitoring.register_event_duration_secs_listener(listen)
    return spans


def without_pictures() -> None:
    """Only the verdict and its numbers: no maps, proposal, report and curves, which no score is made of."""
    from bayessim_mjx import report
    from bayessim_mjx.diagnosis import run

    run.STAGES = tuple(stage for stage in run.STAGES if not stage.optional)
    report.write = lambda result, folder, *more: None
    report.tensorboard = lambda result, folder: None


def covered(spans: list[tuple[float, float]]) -> float:
    """Seconds inside of any of the spans: programs are traced within others."""
    total, end = 0.0, -1.0
    for first, last in sorted(spans):
        total += max(last - max(first, end), 0.0)
        end = max(end, last)
    return total


def oracle(found: Any, effects: list[dict[str, Any]], joint_of: dict[str, str]) -> dict[str, Any]:
    """What the true effects close, fitted like any other model of the search; None where the library lacks one."""
    from baselines import candidate_of, closure, fitted

    chosen = [candidate_of(found.pool, e["name"], e["where"], joint_of) for e in effects]
    if not effects or None in chosen:
        return {"closure": None, "effects": [e["name"] for e in effects]}
    model = fitted(found.pool, chosen)
    return {"closure": closure(found, model), "effects": [c.label for c in chosen]}


def joints_of(folder: Path) -> dict[str, str]:
    """{actuator: the joint that it drives}."""
    import mujoco

    model = mujoco.MjModel.from_xml_path(str(folder / "model.xml"))
    return {model.actuator(i).name: model.joint(model.actuator_trnid[i, 0]).name for i in range(model.nu)}


def _write(path: Path, content: Any) -> None:
    from bayessim_mjx import atomic

    atomic.write_text(path, json.dumps(content, indent=1, default=float))


def work(case: Path, out: Path, baselines: bool, arguments: list[str]) -> int:
    """Run one case; the exit code."""
    from cases import ACCURACY

    given = ["--model", case / "model.xml", "--data", case / "logs", "--out", out, "--seed", "0", "--headless"]
    given += ["--accuracy", ACCURACY]
    code, ended, found = diagnose([str(a) for a in [*given, *arguments]])
    if found is not None:
        started = time.perf_counter()
        truth = json.loads((case / "truth.json").read_text())
        _write(out / "oracle.json", oracle(found, truth["effects"], joints_of(case)))
        ended["oracle_seconds"] = time.perf_counter() - started
    if code == 130:  # Ctrl-C: to be run again
        return code
    _write(out / "exit.json", {"code": code} | ended)
    if found is not None and baselines:
        from baselines import all_baselines

        _write(out / "baselines.json", all_baselines(found))
    return code


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("case", type=Path)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--baselines", action="store_true")
    parser.add_argument("--verdict-only", action="store_true")
    parser.add_argument("--more", nargs=argparse.REMAINDER, default=[], help="arguments of the command; last")
    args = parser.parse_args()
    if args.verdict_only:
        without_pictures()
    return work(args.case, args.out, args.baselines, args.more)


if __name__ == "__main__":
    sys.exit(main())
