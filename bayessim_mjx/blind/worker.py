"""A process that makes cases and has them diagnosed, one after the other, as it reads them from its input.

Every diagnosis is a process of its own, in a folder that holds nothing but the logs of its case.
"""

import dataclasses
import json
import os
import shlex
import shutil
import signal
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from bayessim_mjx import atomic, cli, trust
from bayessim_mjx.blind.cases import ITEM, Item, again, make
from bayessim_mjx.blind.check import Check, bench, loader
from bayessim_mjx.blind.process import STOPPED, run
from bayessim_mjx.blind.reality.menu import KNOWN
from bayessim_mjx.blind.reality.plant import Plant
from bayessim_mjx.blind.reality.twin import base_of, closed, twins
from bayessim_mjx.errors import UserError
from bayessim_mjx.outside_tasks import is_file

TIMEOUT = 3600.0  # s per diagnosis, against one that hangs
KEPT = ("diagnosis.json", "answer.json")
EXIT = "exit.json"


def command(check: Check, data: Path, out: Path) -> list[str]:
    """Build the command of an entry (only `{model}`, `{data}` and `{out}` are replaced), or ours without one."""
    model = str(Path(check.model).resolve()) if check.model else str(data.parent / "model.xml")
    if check.command:
        words = shlex.split(check.command)
        for name, path in (("{model}", model), ("{data}", str(data)), ("{out}", str(out))):
            words = [w.replace(name, path) for w in words]
        return [str(Path(w).resolve()) if Path(w).is_file() else w for w in words]  # it runs in another folder
    robot = ["--task", check.task] if check.task else ["--model", model, *_of_urdf(check)]
    accuracy = ["--accuracy", f"{100 * check.accuracy:g}%"]
    own = [sys.executable, "-m", "bayessim_mjx.diagnose", *robot, "--data", str(data), "--out", str(out)]
    named = ["--effects", ",".join(("all", *check.asked))] if check.asked else []
    return [*own, *accuracy, "--seed", "0", "--headless", "--verdict_only", *named, *check.more]


def _of_urdf(check: Check) -> list[str]:
    """Return the flags of a URDF, with full paths: a diagnosis runs in another folder."""
    parts = [part.rpartition("=") for part in check.packages]
    packages = [f"{name}{sign}{Path(folder).resolve()}" for name, sign, folder in parts]
    drive = str(Path(check.drive).resolve()) if Path(check.drive).is_file() else check.drive
    return cli.urdf_words(drive, packages)


def diagnose(check: Check, index: int) -> str:
    """Diagnose the logs of a case; what came of it, in one line."""
    answer = check.answer(index)
    if (answer / EXIT).exists():
        return "was there"
    answer.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix="blind_") as folder:
        work = Path(folder)
        shutil.copytree(check.given(index) / "logs", work / "logs")
        if check.command and check.task:
            (work / "model.xml").write_text(loader(check)().to_xml())
        out, words = work / "out", command(check, work / "logs", work / "out")
        if not shutil.which(words[0]):
            raise UserError(f"--command {words[0]}: there is no such program")
        with (answer / "output.txt").open("w") as text:
            ended = run(words, work, text, TIMEOUT, check.sealed if check.sandbox else None)
        for name in KEPT:
            if (out / name).exists():
                shutil.copy(out / name, answer / name)
    if ended.code in STOPPED:
        raise KeyboardInterrupt
    report: dict[str, Any] = dataclasses.asdict(ended) | {"seal": check.seal(index).read_text()}
    report["closed"] = really_closed(check, index) if ended.code == 0 else None
    atomic.write_text(answer / EXIT, json.dumps(report))
    return f"exit {ended.code}"


def really_closed(check: Check, index: int) -> float | None:
    """Compute the share of the gap in the finer reality that a diagnosis closes; None where it names nothing
    that can be put there, or gives no known parameter.
    """
    answer = next((p for p in (check.answer(index) / n for n in KEPT) if p.exists()), None)
    said = json.loads(answer.read_text()) if answer else {}
    truth, own = json.loads(check.secret(index).read_text()), bench(check)
    effects = said.get("effects", []) if said.get("verdict") in ("effects", "ambiguous") else []
    known = all(e["name"] in KNOWN for e in truth["effects"])
    causes = twins(own.ruler.system, own.scales, effects) if effects and truth["effects"] and known else None
    if not causes:
        return None
    rig, base = own.ruler.system, base_of(said.get("parameters", {}), list(truth["base"]))
    if not base:
        return None
    hidden = [again(check, own, Item(**{k: truth[k] for k in ITEM}), e["size"]) for e in truth["effects"]]
    return closed(own.ruler, Plant(rig, truth["base"], hidden), Plant(rig, base, causes))


def work(check: Check, item: Item) -> dict[str, Any]:
    """{"index", "told", "seconds"}, or {"error"} for what the user can mend."""
    started = time.perf_counter()
    try:
        make(check, bench(check), item)
        report = diagnose(check, item.index)
    except UserError as error:
        return {"error": str(error)}
    return {"index": item.index, "told": report, "seconds": time.perf_counter() - started}


def main() -> int:
    """First line: the check; then one item a line, answered by a line each."""
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # so that the diagnosis ends with its worker
    first = json.loads(sys.stdin.readline())
    given: dict[str, Any] = {k: tuple(v) if isinstance(v, list) else v for k, v in first.items()}
    check, answers = Check(**given), os.fdopen(os.dup(1), "w")
    if is_file(check.task):  # the user named it to the command that started this process
        trust.allow([check.task.rpartition(":")[0]])
    os.dup2(2, 1)  # whatever prints must not answer
    for line in sys.stdin:
        try:
            answer = work(check, Item(**json.loads(line)))
        except KeyboardInterrupt:
            return 130
        print(json.dumps(answer), file=answers, flush=True)
    return 0


def asked(check: Check) -> str:
    """Write the first line for a worker."""
    return json.dumps(dataclasses.asdict(check))


if __name__ == "__main__":
    sys.exit(main())
