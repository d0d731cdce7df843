"""Whether a change of the code leaves diagnoses as they were, byte for byte: three pendulums with few effects on offer.

    python benchmarks/diagnosis/same.py record FOLDER    at the commit before
    python benchmarks/diagnosis/same.py compare FOLDER   at the commit after; exit code 1 where anything differs

`record` writes logs and model too, and `compare` diagnoses the same files. Compared is everything that the command
writes but for pictures; versions and the date are left out. Both have to run on one machine with the same libraries.
Two minutes each on one core.
"""

import argparse
import difflib
import os
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[2]))

SHORT: dict[str, Any] = {"count": 4, "seconds": 3.0}
FEW = "coulomb_friction,viscous_friction,actuator_delay,actuator_gain,payload"
CASES: dict[str, tuple[dict[str, Any], str]] = {
    "friction": ({"friction": 0.04, "scale": (0.9, 1.1, 0.95)}, FEW),
    "both": ({"friction": 0.06, "delay": 0.008, "scale": (1.1, 0.92, 1.05), "seed": 3}, FEW),
    "not_on_offer": ({"friction": 0.08, "scale": (1.1, 0.92, 1.05), "seed": 4}, "actuator_delay,payload"),
}
FILES = ("diagnosis.json", "details.json", "effects.yaml", "model_with_effects.xml", "next_experiment.csv")
ONE = {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}  # how threads share a sum depends on the machine's load
CHANGING = r'"(date|bayessim-mjx|mujoco|mujoco-mjx|jax|numpy)": "[^"]*"'


def record(folder: Path) -> None:
    """Logs, model and a first diagnosis of every case."""
    from tests.diagnosis.pendulums import nominal, recorded, saved

    for name, (truth, effects) in CASES.items():
        logs = folder / name / "logs"
        logs.mkdir(parents=True)
        nominal(folder / name)
        saved(logs, recorded(**SHORT, **truth))
        _diagnose(folder / name, effects, "before")


def _diagnose(case: Path, effects: str, out: str) -> None:
    given = ["--model", "pendulum.xml", "--data", "logs", "--effects", effects, "--out", out, "--headless"]
    command = [sys.executable, "-m", "bayessim_mjx.diagnose", *given, "--device", "cpu"]
    with open(case / f"{out}.txt", "w") as log:
        subprocess.run(command, cwd=case, env=os.environ | ONE, stdout=log, stderr=subprocess.STDOUT, check=True)


def differences(case: Path) -> list[str]:
    """Lines that changed, with the file's name; a file that only one of the two wrote is one line."""
    out = []
    for file in FILES:
        before, after = (_lines(case / side / file, side) for side in ("before", "after"))
        changed = [
            line for line in difflib.unified_diff(before, after, lineterm="", n=0) if line[:2] not in ("--", "++")
        ]
        out += [f"{case.name}/{file}: {line[:200]}" for line in changed if not line.startswith("@@")]
    return out


def _lines(path: Path, side: str) -> list[str]:
    """Without what changes from day to day; one number or word a line, so that long lines can be compared too."""
    if not path.is_file():
        return ["no such file"]
    text = re.sub(CHANGING, r'"\1": ""', path.read_text()).replace(f"{side}/", "")
    return text.replace(", ", ",\n").splitlines()


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("what", choices=("record", "compare"))
    parser.add_argument("folder", type=Path)
    args = parser.parse_args()
    if args.what == "record":
        record(args.folder.resolve())
        return 0
    changed = []
    for name, (_, effects) in CASES.items():
        _diagnose(args.folder.resolve() / name, effects, "after")
        changed += differences(args.folder / name)
    print("\n".join(changed[:100]) or f"the same: {', '.join(CASES)}")
    return int(bool(changed))


if __name__ == "__main__":
    sys.exit(main())
