"""Makes a case and has it diagnosed, in any process: `pool` calls `work`.

Every diagnosis is a process of its own, in a folder that holds nothing but the logs of its case.
"""

import dataclasses
import json
import platform
import shlex
import shutil
import sys
import tempfile
import threading
import time
from pathlib import Path
from typing import Any

from bayessim_mjx import atomic, cli, trust
from bayessim_mjx.blind.cases import ITEM, Item, again, make
from bayessim_mjx.blind.check import SETTINGS, Check, bench, loader
from bayessim_mjx.blind.process import STOPPED, apart, run
from bayessim_mjx.blind.reality.menu import KNOWN
from bayessim_mjx.blind.reality.plant import Plant
from bayessim_mjx.blind.reality.twin import base_of, closed, twins
from bayessim_mjx.errors import UserError
from bayessim_mjx.outside_tasks import is_file

TIMEOUT = 3600.0  # s per diagnosis, against one that hangs
KEPT = ("diagnosis.json", "answer.json")
EXIT = "exit.json"
_BENCH = threading.Lock()  # of the bench's plants, where a worker of a cluster has several threads
_lasted = 0.0  # s that the last case of this process took


@dataclasses.dataclass(frozen=True)
class Terms:
    """What holds for every case, whichever machine makes it.

    end: s since the epoch; no case is begun that is likely to last longer. None: no limit.
    apart: truths are to be kept from a diagnosis; remote: it may run on a cluster.
    """

    end: float | None = None
    apart: bool = False
    remote: bool = False


def command(check: Check, data: Path, out: Path) -> list[str]:
    """Build the command of an entry (only `{model}`, `{data}` and `{out}` are replaced), or ours without one.

    It runs in another folder: `check` names its files by full paths (`Check.anywhere`).
    """
    model = check.model or str(data.parent / "model.xml")
    if check.command:
        words = shlex.split(check.command)
        for name, path in (("{model}", model), ("{data}", str(data)), ("{out}", str(out))):
            words = [w.replace(name, path) for w in words]
        return words
    urdf = cli.urdf_words(check.drive, check.packages)
    robot = ["--task", check.task] if check.task else ["--model", model, *urdf]
    accuracy = ["--accuracy", f"{100 * check.accuracy:g}%"]
    own = [sys.executable, "-m", "bayessim_mjx.diagnose", *robot, "--data", str(data), "--out", str(out)]
    named = ["--effects", ",".join(("all", *check.asked))] if check.asked else []
    return [*own, *accuracy, "--seed", "0", "--headless", "--verdict_only", *named, *check.more]


def diagnose(check: Check, index: int, terms: Terms) -> None:
    """Diagnose the logs of a case."""
    answer = check.answer(index)
    if (answer / EXIT).exists():
        return
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
            ended = run(words, work, text, TIMEOUT, check.sealed if check.sandbox else None, terms.remote)
        for name in KEPT:
            if (out / name).exists():
                shutil.copy(out / name, answer / name)
    if ended.code in STOPPED:
        raise KeyboardInterrupt
    report: dict[str, Any] = dataclasses.asdict(ended) | {"seal": check.seal(index).read_text()}
    with _BENCH:
        report["closed"] = really_closed(check, index) if ended.code == 0 else None
    atomic.write_text(answer / EXIT, json.dumps(report))


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


def work(check: Check, terms: Terms, item: Item) -> int | None:
    """Make a case and diagnose it; its index, or None if there is no time for it.

    Raises:
        UserError: what the user can mend.
        KeyboardInterrupt: somebody stopped the diagnosis; the case is to be run again.
    """
    global _lasted
    if terms.end is not None and time.time() + _lasted >= terms.end:
        return None
    _can_run(check, terms)
    started = time.perf_counter()
    with _BENCH:
        make(check, bench(check), item)
    diagnose(check, item.index, terms)
    _lasted = time.perf_counter() - started
    return item.index


def _can_run(check: Check, terms: Terms) -> None:
    """Refuse a machine that lacks the check's files, or what keeps the truths from a diagnosis."""
    here = platform.node()
    if not (check.folder / SETTINGS).exists():
        raise UserError(
            f"{check.folder} is not there on {here}; allowed: an --out, model and logs that all workers share"
        )
    if check.sandbox and terms.apart and not apart():
        ways = "give workers with Linux 5.13 or newer, or --no_sandbox"
        raise UserError(f"{here} has no Landlock, so a diagnosis there could read the truths; {ways}")
    if is_file(check.task):  # the user named it to the command that began this call
        trust.allow([check.task.rpartition(":")[0]])
