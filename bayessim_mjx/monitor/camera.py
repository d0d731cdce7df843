"""Where to look from: the model's own camera, or one fitted to the motion."""

from typing import Any

import numpy as np

from bayessim_mjx.errors import UserError


def view_of(model: Any, data: Any, qpos: np.ndarray, camera: str | int | None, aspect: float) -> Any:
    """`mujoco.MjvCamera` for motion qpos [T, nq]: `camera` by name or number, else the first, else a fitted one.

    Raises:
        ValueError: the model has no such camera.
    """
    import mujoco

    view = mujoco.MjvCamera()
    if camera is None and model.ncam == 0:
        return _fitted(view, model, data, qpos, aspect)
    view.type, view.fixedcamid = mujoco.mjtCamera.mjCAMERA_FIXED, _number(model, camera if camera is not None else 0)
    return view


def reach(model: Any) -> np.ndarray:
    """Poses [21, nq] over the ranges of all joints, so that a camera fitted to them sees whatever comes.

    Hinges without limits turn once. Slides without limits and free roots stay where they are.
    """
    import mujoco

    rng, count = np.random.default_rng(0), 21  # steps of 18 degrees: a turn's four extremes are among them
    poses = np.tile(model.qpos0, (count, 1))
    for joint in range(model.njnt):
        kind, address = model.jnt_type[joint], model.jnt_qposadr[joint]
        hinge, slide = kind == mujoco.mjtJoint.mjJNT_HINGE, kind == mujoco.mjtJoint.mjJNT_SLIDE
        limited = bool(model.jnt_limited[joint])
        if hinge or (slide and limited):
            low, high = model.jnt_range[joint] if limited else (-np.pi, np.pi)
            poses[:, address] = rng.permutation(np.linspace(low, high, count))  # each range is covered evenly
        elif kind == mujoco.mjtJoint.mjJNT_BALL:
            turns = rng.normal(size=(count, 4))
            poses[:, address : address + 4] = turns / np.linalg.norm(turns, axis=1, keepdims=True)
    return poses


def _number(model: Any, camera: str | int) -> int:
    names = [model.camera(i).name for i in range(model.ncam)]
    if isinstance(camera, str) and camera in names:
        return names.index(camera)
    if not isinstance(camera, str) and 0 <= int(camera) < model.ncam:
        return int(camera)
    raise UserError(f"the model has no camera {camera!r}; it has {names or 'none'}")


def _fitted(view: Any, model: Any, data: Any, qpos: np.ndarray, aspect: float) -> Any:
    """Follow a free-floating root; stand still for anything mounted, far enough to see all of its motion."""
    import mujoco

    root = _free_root(model)
    view.azimuth, view.elevation = (130.0, -20.0) if root else (_across(model), -12.0)
    low, high = _bounds(model, data, qpos, root)
    if root:
        view.type, view.trackbodyid = mujoco.mjtCamera.mjCAMERA_TRACKING, root
    else:
        view.type, view.lookat[:] = mujoco.mjtCamera.mjCAMERA_FREE, (low + high) / 2
    side = np.array([-np.sin(np.radians(view.azimuth)), np.cos(np.radians(view.azimuth))])
    half = (high - low) / 2
    # what must fit above and beside the middle of the picture
    need = max(half[2], float(np.abs(side) @ half[:2]) / aspect, 1e-3)
    depth = float(np.hypot(*half[:2])) if root else 0.0
    view.distance = 1.15 * need / np.tan(np.radians(model.vis.global_.fovy) / 2) + depth
    return view


def _free_root(model: Any) -> int:
    """Body number of the first free-floating root with joints below it or alone, 0 if there is none."""
    import mujoco

    for joint in range(model.njnt):
        if model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_FREE:
            return int(model.jnt_bodyid[joint])
    return 0


def _across(model: Any) -> float:
    """Azimuth that looks along the first horizontal hinge, so that planar motion is seen face on; else a corner."""
    import mujoco

    for joint in range(model.njnt):
        x, y, z = model.jnt_axis[joint]
        if model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_HINGE and abs(z) < 0.5:
            return float(np.degrees(np.arctan2(abs(y), x if y >= 0 else -x)))
    return 130.0


def _bounds(model: Any, data: Any, qpos: np.ndarray, root: int) -> tuple[np.ndarray, np.ndarray]:
    """Box [3], [3] round the moving geoms over the motion, relative to the root where there is one."""
    import mujoco

    moving = (model.body_weldid[model.geom_bodyid] != 0) & (model.geom_rbound > 0)
    if not moving.any():
        moving = model.geom_rbound > 0
    if not moving.any():
        return model.stat.center - model.stat.extent / 2, model.stat.center + model.stat.extent / 2
    radius = model.geom_rbound[moving][:, None]
    lows, highs = [], []
    for pose in qpos[:: max(1, len(qpos) // 20)]:
        data.qpos[:] = pose
        mujoco.mj_kinematics(model, data)
        centre = data.geom_xpos[moving] - (data.xpos[root] if root else 0.0)
        lows.append((centre - radius).min(0))
        highs.append((centre + radius).max(0))
    return np.min(lows, 0), np.max(highs, 0)
