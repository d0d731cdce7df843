"""Pictures of worlds, drawn one by one, as Gymnasium's and Stable-Baselines3's `render` do."""

from collections import OrderedDict
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from bayessim_mjx.env import Env
from bayessim_mjx.monitor.camera import reach
from bayessim_mjx.monitor.rendering import Renderer, warn_once
from bayessim_mjx.monitor.video import model_at

WIDTH, HEIGHT = 480, 360  # pixels of a picture
MODELS = 64  # compiled models that are kept, one for each theta
RENDERERS = 4  # each takes the memory of a shadow map, 64 MB where the model does not say otherwise


class _Scene(NamedTuple):
    """Renderer and point of view of one theta, fixed as long as theta is; no renderer where OpenGL does not work."""

    renderer: Renderer | None
    view: Any


class Camera:
    """Pictures of worlds, each with its own parameters.

    What a theta needs is kept while it stays, and so is the point of view: in films nothing moves but the robot.
    """

    def __init__(self, env: Env) -> None:
        self.env = env
        self._models: OrderedDict[bytes, Any] = OrderedDict()
        self._scenes: OrderedDict[bytes, _Scene] = OrderedDict()

    def __call__(self, qpos: np.ndarray, theta: np.ndarray, observation: np.ndarray | None = None) -> np.ndarray | None:
        """`[HEIGHT, WIDTH, 3]` uint8; None, with a warning, where no OpenGL works.

        Args:
            qpos: `[nq]`.
            theta: `[d]`.
            observation: group "policy" `[n]`, where the task's goals are to be seen.
        """
        marks = None if observation is None else self.env.marks(qpos[None], observation[None])
        model = _kept(self._models, theta.tobytes(), MODELS, lambda: model_at(self.env, theta))
        try:
            renderer, view = _kept(self._scenes, theta.tobytes(), RENDERERS, lambda: _scene(model))
            return None if renderer is None else renderer.frames(qpos[None], view, marks)[0]
        except Exception as error:  # drivers fail in many ways, and no picture may end a run
            warn_once(f"no picture: rendering failed ({type(error).__name__}: {error})")
            return None


def _scene(model: Any) -> _Scene:
    renderer = Renderer.of(model, WIDTH, HEIGHT)
    return _Scene(renderer, None if renderer is None else renderer.view(reach(model)))


def _kept(store: OrderedDict[bytes, Any], key: bytes, most: int, make: Callable[[], Any]) -> Any:
    """Get what `store` has for `key`, made where it is missing; the `most` last ones requested stay."""
    if key not in store:
        store[key] = make()
        if len(store) > most:
            store.popitem(last=False)
    store.move_to_end(key)
    return store[key]
