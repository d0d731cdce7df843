"""A pendulum and short logs of it, moved by plain MuJoCo."""

from pathlib import Path

import mujoco
import numpy as np

PENDULUM = """<mujoco><option timestep=".005"/><worldbody><body name="base"><geom size=".05" mass="3"/>
<body name="link"><joint name="hinge" axis="0 1 0" damping=".02" armature=".006"/>
<geom type="capsule" fromto="0 0 0 0 0 -.4" size=".02" mass=".6" contype="0" conaffinity="0"/></body></body></worldbody>
<actuator><motor name="motor" joint="hinge" gear="2" ctrlrange="-4 4"/></actuator></mujoco>"""


def pendulum(folder: Path, seconds: float = 1.5, sigma: float = 4e-4, period: float = 0.02) -> Path:
    """folder/model.xml and two logs of it in folder/logs; returns the folder."""
    (folder / "logs").mkdir(parents=True)
    (folder / "model.xml").write_text(PENDULUM)
    model, rng = mujoco.MjModel.from_xml_string(PENDULUM), np.random.default_rng(0)
    for name, pace in (("slow", 3.0), ("fast", 9.0)):
        data, rows = mujoco.MjData(model), []
        for row in range(round(seconds / period)):
            u = 0.5 * np.sin(pace * row * period)
            rows.append([row * period, u, data.qpos[0] + sigma * rng.normal()])
            data.ctrl[:] = u
            mujoco.mj_step(model, data, nstep=round(period / model.opt.timestep))
        table = np.array(rows)
        np.savetxt(
            folder / "logs" / f"{name}.csv", table, delimiter=",", header="time,ctrl:motor,qpos:hinge", comments=""
        )
        (folder / "logs" / f"{name}.yaml").write_text(f"condition: {name}\n")
    return folder
