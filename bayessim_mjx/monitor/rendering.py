"""Pictures of MuJoCo poses off the screen: an OpenGL context wherever there is one, and MuJoCo's renderer on it."""

import copy
import os
import platform
import warnings
import weakref
from typing import Any

import numpy as np

from bayessim_mjx.monitor.camera import view_of

_OFF = ("disable", "disabled", "off", "false", "0")
_warned: set[str] = set()


def warn_once(text: str) -> None:
    """Give a warning once in a process."""
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


def _open(width: int, height: int) -> Any:
    """Open a current OpenGL context; None with one warning where there is none.

    MuJoCo fixes its backend when it is first imported, long before the first video; so the context is made
    here from the backend's own module and works whatever was imported before.
    """
    failures = []
    for name in backends():
        try:
            return _make_context(name, width, height)
        except Exception as error:
            failures.append(f"{name}: {error}")
    warn_once("no video: " + ("; ".join(failures) or "rendering is switched off by MUJOCO_GL"))
    return None


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
    renderer = Renderer.of(model, width, height)
    if renderer is None:
        return None
    length = max(map(len, worlds))
    try:
        tiles = []
        for world, marks in zip(worlds, mocap or [None] * len(worlds), strict=True):
            frames = renderer.frames(world, renderer.view(world, camera), marks)
            tiles.append(np.stack(frames + [frames[-1]] * (length - len(frames))))
    finally:
        renderer.close()
    return tiles


class Renderer:
    """Pictures of one model, on an OpenGL context of its own that lasts until `close` or until nobody has it any more.

    The context takes several times as long to make as a picture, so callers that draw single pictures keep it.
    """

    @classmethod
    def of(cls, model: Any, width: int, height: int) -> "Renderer | None":
        """Of `mujoco.MjModel`, which stays as it is, in pixels; None, with one warning, where no OpenGL works."""
        context = _open(width, height)
        return None if context is None else cls(model, context, width, height)

    def __init__(self, model: Any, context: Any, width: int, height: int) -> None:
        import mujoco

        self.model, self._context, self.aspect = _lit(model, width, height), context, width / height
        self.data = mujoco.MjData(self.model)
        try:
            self._picture = _Picture(self.model, width, height)
        except Exception:
            context.free()
            raise
        self.close = weakref.finalize(self, _freed, self._picture, context)
        self.close.atexit = False  # EGL has gone by then, and all that it held

    def view(self, seen: np.ndarray, camera: str | int | None = None) -> Any:
        """`mujoco.MjvCamera`, fitted to poses `seen` [T, nq] where the model has none, see `camera.view_of`."""
        return view_of(self.model, self.data, seen, camera, self.aspect)

    def frames(self, world: np.ndarray, view: Any, marks: np.ndarray | None = None) -> list[np.ndarray]:
        """Draw a picture of every row of qpos [T, nq]; rows that repeat the one before are not drawn again."""
        self._context.make_current()  # others may have been opened since
        out: list[np.ndarray] = []
        for k, pose in enumerate(world):
            same = k > 0 and np.array_equal(pose, world[k - 1])
            if marks is not None:
                same = same and np.array_equal(marks[k], marks[k - 1])
                self.data.mocap_pos[:], self.data.mocap_quat[:] = marks[k, :, :3], marks[k, :, 3:]
            out.append(out[-1] if same else self._picture.take(self.data, pose, view))
        return out


def _freed(picture: "_Picture", context: Any) -> None:
    context.make_current()
    picture.free()
    context.free()


def _lit(model: Any, width: int, height: int) -> Any:
    """Copy the model with a buffer for pictures of this size, and with light where it has none."""
    model = copy.copy(model)
    model.vis.global_.offwidth, model.vis.global_.offheight = 2 * width, 2 * height
    model.vis.quality.offsamples = 0
    if model.nlight == 0:
        model.vis.headlight.ambient[:], model.vis.headlight.diffuse[:] = 0.45, 0.55
    return model


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
    """Sum over 2 x 2 pixels of x [2 H, 2 W, ...]."""
    x = x.astype(np.uint16)
    return x[::2, ::2] + x[1::2, ::2] + x[::2, 1::2] + x[1::2, 1::2]


def _has_sky(model: Any) -> bool:
    import mujoco

    return bool((np.asarray(model.tex_type) == mujoco.mjtTexture.mjTEXTURE_SKYBOX.value).any())
