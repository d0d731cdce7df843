"""How well the attitude of a floating base is known that nobody measured: written cases of `quadruped.py`.

    python benchmarks/diagnosis/quadruped.py OUT --robot quadruped --place ground --fault null
    python benchmarks/diagnosis/attitude.py OUT [OUT ...]

Of each log: the root mean square angle between the estimated and the true vertical, the standard deviation that the
estimate states (of one of two angles), and the share of the rows within its 95 % region.
"""

import argparse
import warnings
from collections.abc import Iterator
from pathlib import Path

import mujoco
import numpy as np

from bayessim_mjx.logs import read_logs
from bayessim_mjx.odometry import base, imu

REGION = np.sqrt(-2.0 * np.log(0.05))  # standard deviations, of two angles of the same one


def judged(folder: Path) -> Iterator[tuple[str, float, float, float, float]]:
    """(log, rms angle in degrees, stated sd in degrees, share inside, largest error of the height in m)."""
    model = mujoco.MjModel.from_xml_path(str(folder / "robot.xml"))
    for file in sorted((folder / "logs").glob("*.csv")):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            (log,) = read_logs(file, model, partial=True)
        truth = np.load(folder / "base" / f"{file.stem}.npz")
        rows = np.searchsorted(truth["time"], log.time - 1e-6)
        found = base.estimate(log, model)
        up, right = (np.stack([imu.rotation(q)[2] for q in x]) for x in (found.qpos[:, 3:], truth["pose"][rows, 3:]))
        angle = np.degrees(np.arccos(np.clip(np.sum(up * right, axis=1), -1.0, 1.0)))
        stated = np.degrees(found.sd_qpos[:, 3])
        height = float(np.abs(found.qpos[:, 2] - truth["pose"][rows, 2]).max())
        inside = float(np.mean(angle < REGION * stated))
        yield file.stem, float(np.sqrt(np.mean(angle**2))), float(stated.mean()), inside, height


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folders", type=Path, nargs="+", help="folders that quadruped.py wrote, on the ground")
    rows = [(folder.name, *row) for folder in parser.parse_args().folders for row in judged(folder)]
    for name, log, angle, stated, inside, height in rows:
        print(f"{name:20} {log:6} {angle:.3f} deg, stated {stated:.3f}; inside {inside:.1%}; height {height:.4f} m")
    angle, stated, inside, height = np.array([row[2:] for row in rows]).T
    print(f"{len(rows)} logs: rms {np.sqrt(np.mean(angle**2)):.3f} deg, largest {angle.max():.3f}", end="; ")
    print(f"stated {stated.mean():.3f}; rows inside {inside.mean():.1%}; height {height.max():.4f} m at most")


if __name__ == "__main__":
    main()
