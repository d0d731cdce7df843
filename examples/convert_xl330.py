"""Convert the XL330 servo logs of Rhoban's BAM (JSON) into the library's CSV: python examples/convert_xl330.py OUT.

The command is the motor voltage: the PWM duty (of 885, a signed 16-bit register stored unsigned) times the supply of
7.4 V. Where the torque was switched off the register reads 0, but the motor's leads are open: no command of 0 V, which
would brake. The stream `enabled:motor` says so, and windows that touch such rows are not used.
"""

import argparse
import json
import sys
from pathlib import Path

import numpy as np

RAW = Path(__file__).resolve().parents[2] / "shared" / "data" / "xl330_servo" / "raw"
FULL_DUTY = 885


def convert(out: Path, raw: Path = RAW) -> list[Path]:
    """Write one CSV and its side YAML per JSON file in `raw`; returns the CSV files."""
    out.mkdir(parents=True, exist_ok=True)
    return [_convert(path, out) for path in sorted(raw.glob("*.json"))]


def _convert(path: Path, out: Path) -> Path:
    run = json.loads(path.read_text())
    rows = {key: np.array([float(e[key]) for e in run["entries"]]) for key in run["entries"][0]}
    duty = (rows["load"] + 32768) % 65536 - 32768
    columns = {
        "time": rows["timestamp"],
        "ctrl:motor": duty / FULL_DUTY * run["vin"],
        "qpos:servo": rows["position"],
        "enabled:motor": rows["torque_enable"],
        "goal": rows["goal_position"],
        "speed_register": rows["speed"],  # 0.024 rad/s steps and late: worse than the derivative of the position
        "voltage": rows["input_volts"],
        "temperature": rows["temp"],
    }
    target = out / f"kp{run['kp']}_{run['trajectory']}.csv"
    np.savetxt(target, np.stack(list(columns.values()), 1), "%.9g", ",", header=",".join(columns), comments="")
    side = {
        "operating_condition": f"kp{run['kp']}",
        "controller": {"law": "voltage", "note": f"firmware P on the goal, gain {run['kp']}, inside the logged duty"},
        "payload": {"mass": run["mass"], "length": run["length"]},
        "source_file": path.name,
    }
    target.with_suffix(".yaml").write_text(json.dumps(side, indent=1))  # JSON is YAML
    return target


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", metavar="OUT", type=Path, help="folder of the CSV files")
    out = parser.parse_args().out
    if not RAW.is_dir():
        sys.exit(f"{RAW} is not there: nothing to convert")
    for written in convert(out):
        print(written)
