"""Small models and the files of their logs."""

from pathlib import Path

import mujoco
import numpy as np
import pytest

from bayessim_mjx.errors import UserError
from bayessim_mjx.logs import read_logs

ARM = """
<mujoco>
  <option timestep="0.005"/>
  <worldbody>
    <body><joint name="shoulder" type="hinge" axis="0 1 0"/><geom size=".02" mass="1" pos="0 0 -.2"/>
      <body pos="0 0 -.4"><joint name="elbow" type="hinge" axis="0 1 0" range="-170 170" limited="true"/>
        <geom size=".02" mass="1" pos="0 0 -.2"/></body></body>
  </worldbody>
  <actuator>
    <motor name="m_shoulder" joint="shoulder" ctrllimited="true" ctrlrange="-2 2"/>
    <motor name="m_elbow" joint="elbow"/>
  </actuator>
</mujoco>"""
FREE = """
<mujoco><option timestep="0.005"/><worldbody><body><freejoint name="root"/>
  <geom type="box" size=".1 .2 .3" mass="1"/></body></worldbody></mujoco>"""
HEADER = "time,ctrl:m_shoulder,ctrl:m_elbow,qpos:shoulder,qpos:elbow"
GOOD_MAP = {"ctrl": {"m_shoulder": 1, "m_elbow": 2}, "qpos": {"shoulder": "qpos:shoulder", "elbow": {"value": 0.0}}}


def rows(count: int = 40, dt: float = 0.01) -> np.ndarray:
    """[count, 5]: time, two commands, two angles; smooth, known."""
    t = dt * np.arange(count)
    return np.stack([t, np.sin(t), np.cos(t), 0.5 * np.sin(3 * t), 0.2 * np.cos(2 * t)], 1)


def write(folder: Path, table: np.ndarray, header: str = HEADER, name: str = "run.csv") -> Path:
    path = folder / name
    np.savetxt(path, table, "%.12g", ",", header=header, comments="")
    return path


def refused(folder: Path, model: mujoco.MjModel, *words: str, map: object = None) -> None:
    with pytest.raises(UserError) as error:
        read_logs(folder, model, map)  # type: ignore[arg-type]
    text = str(error.value)
    assert "\n" not in text
    for word in words:
        assert word in text, text
