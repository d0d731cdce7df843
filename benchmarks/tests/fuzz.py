"""1000 malformed inputs from a seed: does any of them end in a traceback, hang, or crash? What is accepted is listed.

    python benchmarks/tests/fuzz.py [--cases 1000] [--seed 0] [--only KIND ...] [--commands 30] [--out DIR]

Kinds of input, and what is done with them, stand in fuzz_cases.py and fuzz_files.py. Every case is called in a worker
process with a limit of time; a worker that dies or stands still is counted and replaced. `--commands` of the refused
command lines are then run as commands of their own: one line on stderr and exit code 2. Exit code 0 if nothing was
found.
"""

import argparse
import contextlib
import io
import json
import os
import select
import signal
import subprocess
import sys
import tempfile
import time
import traceback
import warnings
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

LIMIT = 30  # s, of a case
STILL = 120  # s without a word after which a worker is given up
GOOD = ("refused", "accepted", "warned")
OUTCOMES = (*GOOD, "harmful", "traceback", "hang", "crash")


class Late(BaseException):
    """A case took too long."""


def outcome(call: Any) -> tuple[str, str]:
    """(one of OUTCOMES, what was said)."""
    from bayessim_mjx.errors import UserError, refused

    def late(*_: Any) -> None:
        raise Late

    signal.signal(signal.SIGALRM, late)
    signal.alarm(LIMIT)
    quiet = io.StringIO()
    try:
        with (
            warnings.catch_warnings(record=True) as caught,
            contextlib.redirect_stdout(quiet),
            contextlib.redirect_stderr(quiet),
        ):
            warnings.simplefilter("always", UserWarning)
            call()
        return ("warned", str(caught[0].message)) if caught else ("accepted", "")
    except UserError as error:
        text = str(error)
        return ("refused" if text.strip() and len(text) < 4000 else "traceback"), text
    except AssertionError as error:
        return "harmful", f"{error} {_where(error)}"
    except Late:
        return "hang", f"over {LIMIT} s"
    except (Exception, SystemExit) as error:
        if refused(error):  # by the system: the commands say so in one line
            return "refused", str(error)
        return "traceback", f"{type(error).__name__}: {error} {_where(error)}"
    finally:
        signal.alarm(0)


def _where(error: BaseException) -> str:
    frames = [f"{Path(f.filename).name}:{f.lineno}" for f in traceback.extract_tb(error.__traceback__)]
    return "(" + " < ".join(frames[:-5:-1]) + ")"


def worker(seed: int, kind: str, numbers: list[int], root: Path) -> None:
    """Print one JSON line when a case begins and one when it has ended."""
    import fuzz_cases

    out, null = os.dup(1), os.open(os.devnull, os.O_WRONLY)
    os.dup2(null, 1)  # libraries that print
    os.dup2(null, 2)
    function, index = fuzz_cases.KINDS[kind][0], list(fuzz_cases.KINDS).index(kind)
    for number in numbers:
        folder = root / f"{kind}_{number}"
        folder.mkdir(parents=True)
        os.chdir(folder)
        what, call = function(np.random.default_rng([seed, index, number]), folder)
        os.write(out, (json.dumps({"number": number, "what": what}) + "\n").encode())
        result, said = outcome(call)
        os.write(out, (json.dumps({"number": number, "outcome": result, "said": said[:600]}) + "\n").encode())


def cases(seed: int, kind: str, count: int, root: Path) -> Iterator[dict[str, Any]]:
    """{kind, number, what, outcome, said} of every case."""
    left = list(range(count))
    while left:
        command = [sys.executable, __file__, "--worker", kind, "--seed", str(seed), "--out", str(root)]
        numbers = ",".join(map(str, left))
        process = subprocess.Popen([*command, "--numbers", numbers], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL)
        assert process.stdout is not None
        begun: dict[str, Any] = {}
        while (line := _line(process.stdout)) is not None and line:
            begun |= json.loads(line)
            if "outcome" in begun:
                yield {"kind": kind, **begun}
                left.remove(begun["number"])
                begun = {}
        process.kill()
        code = process.wait()
        if left:
            end = ("hang", f"still for {STILL} s") if line is None else ("crash", f"exit code {code}")
            yield {"kind": kind, "what": "", **begun, "number": left[0], "outcome": end[0], "said": end[1]}
            left = left[1:]


def _line(stream: Any) -> bytes | None:
    """The next line; empty at the end; None where none comes."""
    ready, _, _ = select.select([stream], [], [], STILL)
    return stream.readline() if ready else None


def commands(seed: int, count: int, root: Path) -> list[dict[str, Any]]:
    """Command lines that were refused in this process, as commands of their own."""
    import fuzz_cases

    found, number = [], 0
    index = list(fuzz_cases.KINDS).index("flags")
    seen = []

    def note(module: Any, argv: list[str]) -> None:
        seen.append([module.__name__, *argv])

    fuzz_cases.begins = note
    while len(found) < count:
        folder = root / f"command_{number}"
        folder.mkdir(parents=True)
        what, call = fuzz_cases.flags(np.random.default_rng([seed, index, number]), folder)
        number += 1
        call()
        if not (root / f"flags_{number - 1}.refused").is_file():
            continue
        began = time.perf_counter()
        command, options = (
            [sys.executable, "-m", *seen[-1]],
            {"capture_output": True, "text": True, "errors": "replace"},
        )
        try:
            done = subprocess.run(command, cwd=folder, timeout=STILL, **options)
        except subprocess.TimeoutExpired:
            found.append({"kind": "commands", "number": number, "what": what, "outcome": "hang", "said": ""})
            continue
        lines = done.stderr.strip().splitlines()
        good = (
            done.returncode == 2
            and len(lines) >= 1
            and lines[-1].startswith("error: ")
            and "Traceback" not in done.stderr
        )
        result = "refused" if good else "crash" if done.returncode < 0 else "traceback"
        said = f"{done.returncode} in {time.perf_counter() - began:.1f} s: {done.stderr[-400:]}"
        found.append({"kind": "commands", "number": number, "what": what, "outcome": result, "said": said})
    return found


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", nargs="+", help="kinds")
    parser.add_argument("--commands", type=int, default=30, help="command lines run as processes")
    parser.add_argument("--out", type=Path, help="folder of the inputs and of cases.jsonl (default: a temporary one)")
    parser.add_argument("--worker", help=argparse.SUPPRESS)
    parser.add_argument("--numbers", help=argparse.SUPPRESS)
    args = parser.parse_args()
    os.environ |= {"BAYESSIM_MJX_CACHE": "off", "JAX_PLATFORMS": "cpu"}
    if args.worker:
        worker(args.seed, args.worker, [int(n) for n in args.numbers.split(",")], args.out)
        return 0
    import fuzz_cases

    out = (args.out or Path(tempfile.mkdtemp(prefix="fuzz_"))).absolute()
    out.mkdir(parents=True, exist_ok=True)
    began, results = time.perf_counter(), []
    for kind, (_, share) in fuzz_cases.KINDS.items():
        if args.only and kind not in args.only:
            continue
        for case in cases(args.seed, kind, max(1, round(share * args.cases / 1000)), out):
            results.append(case)
            if kind == "flags" and case["outcome"] == "refused":
                (out / f"flags_{case['number']}.refused").touch()
    if args.commands and (not args.only or "flags" in args.only):
        results += commands(args.seed, args.commands, out)
    (out / "cases.jsonl").write_text("".join(json.dumps(case) + "\n" for case in results))
    return show(results, out, time.perf_counter() - began)


def show(results: list[dict[str, Any]], out: Path, seconds: float) -> int:
    """The table, what was found, and what was accepted; the exit code."""
    kinds = list(dict.fromkeys(case["kind"] for case in results))
    print(f"{'':14}" + "".join(f"{name:>11}" for name in ("cases", *OUTCOMES)))
    for kind in [*kinds, "all"]:
        count = Counter(case["outcome"] for case in results if kind in ("all", case["kind"]))
        print(f"{kind:14}" + "".join(f"{n:>11}" for n in (count.total(), *(count[name] for name in OUTCOMES))))
    bad = [case for case in results if case["outcome"] not in GOOD]
    for case in bad:
        print(f"{case['outcome']}: {case['kind']} {case['number']}: {case['what']}\n    {case['said']}")
    accepted = [case for case in results if case["outcome"] in ("accepted", "warned")]
    lines = [f"{c['kind']} {c['number']}: {c['what']}{'; told: ' + c['said'] if c['said'] else ''}" for c in accepted]
    (out / "accepted.txt").write_text("\n".join(line.replace("\n", " ") for line in lines) + "\n")
    print(f"{len(accepted)} accepted: {out / 'accepted.txt'}; {seconds:.0f} s")
    return 1 if bad else 0


if __name__ == "__main__":
    sys.exit(main())
