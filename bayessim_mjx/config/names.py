"""Names that a setting takes and that others may add to: summaries, and classes of posterior networks. No jax here.

The library's own names stand here, so that a slip is refused before anything else is imported. What they name is
registered where it is defined (inference/summaries, inference/densities). Others come by `register`, or by the entry
points of installed packages, which are loaded when their name is used.
"""

import math
import re
from collections.abc import Iterator, Mapping
from typing import Any, Protocol

from bayessim_mjx.errors import UserError, nearest


class Entry(Protocol):
    """What is registered."""

    @property
    def name(self) -> str: ...
    @property
    def ending(self) -> Any:
        """What may follow the name after an underscore; None: nothing."""


class Names:
    """The library's names, each with what may follow it, and the entries registered under them and under others.

    Args:
        what: an entry, in messages.
        group: the group of entry points that add to the names.
        library: {name: its ending} of the library's own entries.
        form: regular expression of a name.
    """

    def __init__(self, what: str, group: str, library: Mapping[str, Any], form: str):
        self.what, self.group, self.library, self.form = what, group, dict(library), form
        self._entries: dict[str, Any] = {}

    def register(self, entry: Entry) -> Any:
        """Add an entry under its name, in place of one of that name that is not the library's; returns it.

        Raises:
            UserError: the name is the library's, or has not the form of one.
        """
        name = entry.name
        if not re.fullmatch(self.form, str(name)):
            raise UserError(f"{self.what} {name!r}: the name has to match {self.form}")
        if name in self.library and self._entries.get(name, entry) != entry:
            raise UserError(f"{self.what} {name!r}: the library has one of that name; there are {', '.join(self)}")
        self._entries[name] = entry
        return entry

    def __iter__(self) -> Iterator[str]:
        """All names: the library's, those registered, those of installed packages."""
        return iter(dict.fromkeys([*self.library, *self._entries, *self._installed()]))

    def __contains__(self, name: str) -> bool:
        return name in self.library or name in self._entries or name in self._installed()

    def ending(self, name: str) -> Any:
        """Get what may follow that name."""
        return self.library[name] if name in self.library else self.entry(name).ending

    def entry(self, name: str) -> Any:
        """Get the entry of that name; one of the library exists only after the room that defines it was imported.

        Raises:
            UserError: an installed package that does not give what its entry point promises.
        """
        if name not in self._entries:
            self.register(self._loaded(name))
        return self._entries[name]

    def _installed(self) -> dict[str, Any]:
        from importlib import metadata  # here, so that commands start fast

        return {point.name: point for point in metadata.entry_points(group=self.group)}

    def _loaded(self, name: str) -> Any:
        try:
            entry = self._installed()[name].load()
        except (Exception, SystemExit) as error:
            raise UserError(f"{self.what} {name!r}: its package cannot be imported: {error}") from error
        if getattr(entry, "name", None) != name or not hasattr(entry, "ending"):
            raise UserError(f"{self.what} {name!r}: its entry point gives {entry!r}, which is no {self.what} called so")
        return entry


def kernel_of(ending: str) -> tuple[str, str | float]:
    """Kernel and bandwidth (a number, "median" or "validation") of MDRFF; ValueError with the reason."""
    match = re.fullmatch(r"(RBF|Laplace|Matern12|Matern32|Matern52)(?:_(median|validation|[0-9][0-9.e+-]*))?", ending)
    if ending and match is None:
        raise ValueError
    kernel, bandwidth = match.groups() if match else ("RBF", None)
    if bandwidth in (None, "median", "validation"):
        return kernel, bandwidth or "validation"
    try:
        width = float(bandwidth)
    except ValueError:
        width = math.nan
    if not 0 < width < math.inf:
        raise ValueError(f"the bandwidth {bandwidth} is no positive finite number")
    return kernel, width


# A summary's ending: the option that a number at the end of its name sets.
SUMMARIES = Names(
    "summary",
    "bayessim_mjx.summaries",
    {
        "summary_start": "steps",
        "summary_waypts": "waypoints",
        "summary_corr": "lags",
        "summary_corrdiff": "lags",
        "summary_signatory": "depth",
        "summary_logsignature": "depth",
        "summary_learned": None,
    },
    form="summary_[A-Za-z][A-Za-z0-9_]*",
)
# A density's ending: a function of the text after its name, which may be empty; None: nothing follows.
DENSITIES = Names("density", "bayessim_mjx.densities", {"MDNN": None, "MDRFF": kernel_of}, form="[A-Za-z][A-Za-z0-9]*")
SHAPES = (
    "MDNN, MDRFF, MDRFF_<kernel>, MDRFF_<kernel>_<bandwidth> (kernel RBF, Laplace, Matern12, Matern32 or Matern52; "
    "bandwidth a number, median or validation)"
)


def summary_of(name: str, key: str = "summarizer") -> tuple[str, dict[str, int]]:
    """("summary_corrdiff", {"lags": 3}) of `corrdiff_3`, like BayesSimIG's MDRFF_<kernel>_<sigma>.

    Raises:
        UserError: naming the value, where it came from (`key`) and the summaries that there are.
    """
    stem, _, number = name.rpartition("_")
    numbered = re.fullmatch("[0-9]{1,6}", number) is not None
    full = summary_name(stem if numbered else name)
    if full not in SUMMARIES:
        close = nearest(full, list(SUMMARIES), 1)
        hint = f" (did you mean {close[0]}?)" if close else ""
        raise UserError(f"{key} = {name!r}{hint}: allowed are {', '.join(SUMMARIES)}")
    if not numbered:
        return full, {}
    option = SUMMARIES.ending(full)
    if option is None:
        raise UserError(f"{key} = {name!r}: {full} takes no number")
    return full, {option: int(number)}


def summary_name(value: Any) -> Any:
    """Expand a summary's name: summary_corr of `corr`."""
    return f"summary_{value}" if isinstance(value, str) and not value.startswith("summary_") else value


def model_of(name: str, key: str = "modelClass") -> tuple[str, Any]:
    """("MDRFF", ("RBF", 4.0)) of `MDRFF_RBF_4.0`: the density, and what it makes of the text after its name.

    Raises:
        UserError: naming the value, where it came from (`key`) and what there is.
    """
    stem, underscore, text = name.partition("_")
    reason = ""
    if stem in DENSITIES and bool(underscore) == bool(text):
        ending = DENSITIES.ending(stem)
        try:
            if ending is not None:
                return stem, ending(text)
            if not text:
                return stem, None
        except ValueError as error:
            reason = str(error)
    if reason:
        raise UserError(f"{key} = {name!r}: {reason}")
    others = "".join(f", {other}" for other in DENSITIES if other not in DENSITIES.library)
    raise UserError(f"{key} = {name!r}: allowed are {SHAPES}{others}; and in a run None, plain uniform randomisation")
