"""A diagnosis for people: a page for the browser, pictures for TensorBoard, a few lines for the terminal.

It renders a `Diagnosis` and computes nothing that is not in it.
"""

from bayessim_mjx.report.page import write

__all__ = ["write"]
