"""A diagnosis for people: a page for the browser, pictures for TensorBoard, a few lines for the terminal.

It renders a `Diagnosis` and finds nothing out that is not in it.
"""

from bayessim_mjx.report.board import tensorboard
from bayessim_mjx.report.page import write
from bayessim_mjx.report.terminal import console

__all__ = ["console", "tensorboard", "write"]
