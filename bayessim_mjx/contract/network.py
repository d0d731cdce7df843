"""The policy's ONNX file on this machine: its metadata and its answers."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bayessim_mjx.errors import UserError

Array = NDArray[np.float64]


class Network:
    """An exported policy: observations [K, S] -> actions [K, A].

    Raises:
        UserError: no such file, no ONNX file, or onnxruntime is not installed.
    """

    def __init__(self, path: Path) -> None:
        try:
            import onnxruntime
        except ImportError:
            raise UserError('policy check needs onnxruntime: pip install "bayessim-mjx[export]"') from None
        if not path.is_file():
            raise UserError(f"{path}: no such file; allowed: an ONNX file of bayessim-mjx play --export")
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = 1
        try:
            self.session = onnxruntime.InferenceSession(path, options, providers=["CPUExecutionProvider"])
        except Exception as error:  # onnxruntime has kinds of its own for broken files
            text = " ".join(str(error).split())[:150]
            raise UserError(f"{path}: not a readable ONNX file ({text}); export it again") from None
        inputs = {i.name: i.shape for i in self.session.get_inputs()}
        if "observation" not in inputs or "action" not in [o.name for o in self.session.get_outputs()]:
            raise UserError(f"{path}: its input is {', '.join(inputs)}; allowed: observation, with the output action")
        self.size = inputs["observation"][1]
        self.memory = inputs["memory"][1] if "memory" in inputs else 0

    @property
    def facts(self) -> dict[str, Any]:
        """Return the metadata of the file, texts."""
        return dict(self.session.get_modelmeta().custom_metadata_map)

    def answers(self, observation: Array, memory: Array) -> Array:
        """Actions [K, A] at observations [K, S] and memories [K, M] that do not follow from each other."""
        given = {"observation": observation.astype(np.float32)}
        if self.memory:
            given["memory"] = memory.astype(np.float32)
        return np.asarray(self.session.run(["action"], given)[0], float)

    def run(self, observation: Array, forgets: bool = False) -> Array:
        """Actions [K, A] of one run from its start.

        Args:
            observation: [K, S]; rows that are not finite give NaN. forgets: the memory is zero in every step.
        """
        bad = ~np.isfinite(observation).all(axis=1, keepdims=True)
        filled = np.where(bad, 0.0, observation)
        if not self.memory or forgets:
            out = self.answers(filled, np.zeros((len(filled), self.memory)))
        else:
            memory, rows = np.zeros((1, self.memory), np.float32), []
            for row in filled.astype(np.float32):
                action, memory = self.session.run(
                    ["action", "memory_next"], {"observation": row[None], "memory": memory}
                )
                rows.append(action[0])
            out = np.array(rows, float)
        return np.where(bad, np.nan, out)
