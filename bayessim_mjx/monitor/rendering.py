"""Pictures of MuJoCo poses off the screen: an OpenGL context wherever there is one, and MuJoCo's renderer on it."""

import copy
import os
import platform
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np

from bayessim_mjx.monitor.camera import view_of

_OFF = ("disable", "disabled", "off", "false", "0")
_warned: set[str] = set()


def warn_once(text: str) -> None:
    """A warning that is given once in a process."""
    if text not in _warned:
        _warned.add(text)
        warnings.warn(text, stacklevel=3)


def backends() -> list[str]:
    """OpenGL backends to try, in order: what MUJOCO_GL says, else what suits the platform. Empty: rendering is off."""
    chosen = os.environ.get("MUJOCO_GL", "").lower().strip()
    if chosen in _OFF:
        return []
    if chosen in ("egl", "osmesa", "glfw", "cgl"):
        return [chosen]
    if platform.system() == "Linux":
        return ["egl", "osmesa"] + (["glfw"] if os.environ.get("DISPLAY") else [])
    return ["cgl", "glfw"] if platform.system() == "Darwin" else ["glfw"]


@contextmanager
def _context(width: int, height: int) -> Iterator[Any]:
    """A current OpenGL context, or None.

    MuJoCo fixes its backend when it is first imported, long before anybody asks for a video; so the context is made
    here from the backend's own module and works whatever was imported before.
    """
    context, failures = None, []
    for name in backends():
        try:
            context = _make_context(name, width, height)
            break
        except Exception as error:
            failures.append(f"{name}: {error}")
    if context is None:
        warn_once("no video: " + ("; ".join(failures) or "rendering is switched off by MUJOCO_GL"))
    try:
        yield context
    finally:
        if context is not None:
            context.free()


def _make_context(name: str, width: int, height: int) -> Any:
    import importlib
    import sys

    before = os.environ.get("PYOPENGL_PLATFORM")
    loaded = set(sys.modules)
    try:
        context = importlib.import_module(f"mujoco.{name}").GLContext(width, height)
        context.make_current()
        return context
    except Exception:
        # PyOpenGL keeps the platform it first saw: forget it, or the next backend cannot load.
        for module in set(sys.modules) - loaded:
            if module.split(".")[0] == "OpenGL" or module == f"mujoco.{name}":
                del sys.modules[module]
        if before is None:
            os.environ.pop("PYOPENGL_PLATFORM", None)
        raise


def render(
    model: Any,
    worlds: list[np.ndarray],
    width: int,
    height: int,
    camera: str | int | None,
    mocap: list[np.ndarray | None] | None = None,
) -> Any:
    """Frames [T, H, W, 3] of each world, all T as long as the longest (the last pose is held); None without OpenGL.

    Args:
        model: `mujoco.MjModel`, which stays as it is.
        worlds: qpos [T, nq] of each.
        width, height: pixels of a frame.
        camera: name or number, see `camera.view_of`.
        mocap: poses [T, nmocap, 7] (m, quaternion) of the mocap bodies of each; None: where the model has them.
    """
    import mujoco

    model = copy.copy(model)  # the buffer and the lights are set for the video only
    model.vis.global_.offwidth, model.vis.global_.offheight = 2 * width, 2 * height
    model.vis.quality.offsamples = 0
    if model.nlight == 0:
        model.vis.headlight.ambient[:], model.vis.headlight.diffuse[:] = 0.45, 0.55
    data = mujoco.MjData(model)
    length = max(map(len, worlds))
    with _context(width, height) as context:
        if context is None:
            return None
        picture = _Picture(model, width, height)
        try:
            tiles = []
            for world, marks in zip(worlds, mocap or [None] * len(worlds), strict=True):
                view = view_of(model, data, world, camera, width / height)
                frames = _frames(picture, data, world, marks, view)
                tiles.append(np.stack(frames + [frames[-1]] * (length - len(frames))))
        finally:
            picture.free()
    return tiles


def _frames(picture: "_Picture", data: Any, world: np.ndarray, marks: np.ndarray | None, view: Any) -> list[np.ndarray]:
    """A picture of every row; rows that repeat the one before are not drawn again."""
    out: list[np.ndarray] = []
    for k, pose in enumerate(world):
        same = k > 0 and np.array_equal(pose, world[k - 1])
        if marks is not None:
            same = same and np.array_equal(marks[k], marks[k - 1])
            data.mocap_pos[:], data.mocap_quat[:] = marks[k, :, :3], marks[k, :, 3:]
        out.append(out[-1] if same else picture.take(data, pose, view))
    return out


class _Picture:
    """MuJoCo's renderer on the current context; a missing sky is painted light instead of black.

    Drawn at twice the size and averaged: OpenGL's own smoothing would leave a black rim against the painted sky.
    """

    def __init__(self, model: Any, width: int, height: int):
        import mujoco

        self.mj, self.model = mujoco, model
        self.context = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100.value)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN.value, self.context)
        self.scene, self.option = mujoco.MjvScene(model, 10000), mujoco.MjvOption()
        self.rect = mujoco.MjrRect(0, 0, 2 * width, 2 * height)
        sky = np.linspace((205, 220, 235), (245, 248, 250), height).astype(np.uint16)  # top to bottom
        self.sky = None if _has_sky(model) else sky[:, None]

    def take(self, data: Any, qpos: np.ndarray, view: Any) -> np.ndarray:
        mj, rect = self.mj, self.rect
        data.qpos[:] = qpos
        mj.mj_kinematics(self.model, data)
        mj.mj_comPos(self.model, data)
        mj.mj_camlight(self.model, data)
        mj.mj_tendon(self.model, data)
        everything = mj.mjtCatBit.mjCAT_ALL.value
        mj.mjv_updateScene(self.model, data, self.option, None, view, everything, self.scene)
        mj.mjr_render(rect, self.scene, self.context)
        pixels = np.empty((rect.height, rect.width, 3), np.uint8)
        depth = np.empty((rect.height, rect.width), np.float32)
        mj.mjr_readPixels(pixels, depth, rect, self.context)
        fine = _sum_of_fours(pixels[::-1])  # OpenGL counts rows from the bottom
        if self.sky is not None:  # what nothing covers is black
            fine += _sum_of_fours(depth[::-1] >= 1.0)[..., None] * self.sky
        return (fine // 4).astype(np.uint8)

    def free(self) -> None:
        self.context.free()


def _sum_of_fours(x: np.ndarray) -> np.ndarray:
    """Sums over 2 x 2 pixels of x [2 H, 2 W, ...]."""
    x = x.astype(np.uint16)
    return x[::2, ::2] + x[1::2, ::2] + x[::2, 1::2] + x[1::2, 1::2]


def _has_sky(model: Any) -> bool:
    import mujoco

    return bool((np.asarray(model.tex_type) == mujoco.mjtTexture.mjTEXTURE_SKYBOX.value).any())
