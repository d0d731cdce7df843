"""Fixed-size features of one trajectory, by BayesSimIG's names: each summary is one `Summary`, registered where it is.

A user's own is registered by a call of `register`, or by an entry point of the group bayessim_mjx.summaries
(docs/own_summary.md).
"""

from typing import Any

from bayessim_mjx.config.names import SUMMARIES, summary_of
from bayessim_mjx.inference.summaries import correlations, learned, signatures
from bayessim_mjx.inference.summaries.summary import Stream, Summarizer, Summary, held, register

__all__ = ["Stream", "Summarizer", "Summary", "entry", "held", "names", "register"]

LIBRARY = (correlations, signatures, learned)  # importing them registers what they define


def names() -> list[str]:
    """All names: the library's, those registered, those of installed packages."""
    return list(SUMMARIES)


def entry(name: str, key: str = "summarizer") -> tuple[Summary, dict[str, Any]]:
    """Find the summary that a setting names, and the option that a number at the end of the name sets.

    Raises:
        UserError: naming the value, where it came from (`key`) and the summaries that there are.
    """
    full, options = summary_of(name, key)
    return SUMMARIES.entry(full), options
