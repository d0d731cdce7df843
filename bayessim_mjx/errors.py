"""Errors that are the user's to mend: the commands print them in one line, without a traceback."""

import errno
from collections.abc import Iterable

# What the system refuses for reasons outside of this program: the disk is full, a folder may not be written, a name is
# too long. (An OSError of another kind, such as a file that ought to be there, is a bug.)
_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
_REFUSED = (*_FULL, errno.EROFS, errno.EACCES, errno.EPERM, errno.ENAMETOOLONG, errno.EMFILE, errno.ENFILE, errno.EIO)
MANY = 20  # names, at most, that are listed beside a close one: about four lines of a terminal
_WORDS = ("no space left", "disk quota", "file too large")  # of libraries that report it as an error of their own


class UserError(ValueError):
    """Bad input. The message names the value, where it came from (file, flag, key) and what is allowed."""


class DivergedError(UserError, FloatingPointError):
    """Numbers are no longer finite, under settings that the user can change."""


def nearest(given: str, names: Iterable[str], n: int = 3, cutoff: float = 0.6) -> list[str]:
    """At most `n` of `names` that look like `given`, the likest first."""
    import difflib  # here, so that commands start fast

    return difflib.get_close_matches(given, list(names), n, cutoff)


def unknown(what: str, given: str, allowed: Iterable[str], lister: str = "") -> UserError:
    """Make the error for an unknown name: close ones first; then all, or of many the command that lists them."""
    names = list(allowed)
    last = {n.rpartition(".")[2].lower(): n for n in names}
    close = [last[n] for n in nearest(given.rpartition(".")[2].lower(), last)]
    hint = f" Did you mean {' or '.join(close)}?" if close else ""
    allowed = f"those that `{lister}` prints" if lister and close and len(names) > MANY else ", ".join(names)
    return UserError(f"{what} {given!r} is unknown.{hint} Allowed: {allowed}")


def disk_is_full(error: BaseException) -> bool:
    """Whether the error, or one that caused it, says that nothing more can be written."""
    seen: BaseException | None = error
    while seen is not None:
        text = str(seen).lower()
        if (isinstance(seen, OSError) and seen.errno in _FULL) or any(word in text for word in _WORDS):
            return True
        seen = seen.__cause__ or seen.__context__
    return False


def out_of_memory(error: BaseException) -> bool:
    """Whether arrays did not fit, on this machine or on a device."""
    return isinstance(error, MemoryError) or "RESOURCE_EXHAUSTED" in str(error)


def refused(error: BaseException) -> bool:
    """Whether the system refused to read or write a file, or lacks the memory."""
    return out_of_memory(error) or (isinstance(error, OSError) and error.errno in _REFUSED) or disk_is_full(error)
