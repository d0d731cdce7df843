"""Start a program that can read no file below a folder: python -I confine.py FOLDER ALONE PROGRAM [ARGUMENT ...].

FOLDER: "" hides none. ALONE: if not "", the program can open no TCP connection, where the kernel can refuse it. It ends
with the process that started it, also where that is killed.

Landlock (Linux 5.13 and newer) keeps a process and all that it starts from reading, and cannot be undone by them. It
only allows, so everything beside the folder, and beside each folder above it, is allowed. What is new beside them later
cannot be read either: temporary files belong into a folder that is there before.

It stands alone: it runs before anything of the library is imported.
"""

import ctypes
import os
import signal
import sys
from pathlib import Path

# the same numbers on all machines since Linux 5.1 (include/uapi/asm-generic/unistd.h)
CREATE_RULESET, ADD_RULE, RESTRICT_SELF = 444, 445, 446
VERSION, PATH_BENEATH = 1, 1  # include/uapi/linux/landlock.h, as those of the next line
READ_FILE, REFER = 1 << 2, 1 << 13  # REFER: files may move between folders; without it no folder allows that
CONNECT_TCP = 1 << 1  # of version 4 on, Linux 6.7
PDEATHSIG, NO_NEW_PRIVS = 1, 38  # include/uapi/linux/prctl.h


class _Ruleset(ctypes.Structure):
    _fields_ = (("files", ctypes.c_uint64), ("network", ctypes.c_uint64))


class _Beneath(ctypes.Structure):
    _pack_ = 1
    _layout_ = "ms"  # Python 3.14 wants it where a structure is packed
    _fields_ = (("allowed", ctypes.c_uint64), ("folder", ctypes.c_int32))


def _call(*words: object) -> int:
    """Make a system call and return its answer.

    Raises:
        OSError: it failed.
    """
    answer = ctypes.CDLL(None, use_errno=True).syscall(*words)
    if answer < 0:
        raise OSError(ctypes.get_errno(), os.strerror(ctypes.get_errno()))
    return answer


def version() -> int:
    """Of Landlock, from 1 on; 0 where this system has none."""
    if not sys.platform.startswith("linux"):
        return 0
    try:
        return _call(CREATE_RULESET, None, 0, VERSION)
    except OSError:
        return 0


def beside(folder: Path) -> list[Path]:
    """Everything beside a folder and beside each folder above it."""
    above = [folder, *folder.parents]
    return [p for inner, outer in zip(above, above[1:], strict=False) for p in outer.iterdir() if p != inner]


def hide(folder: Path, alone: bool = False) -> None:
    """From now on this process, and all that it starts, can read no file below `folder`.

    Args:
        alone: it can open no TCP connection either, where the system can refuse that.

    Raises:
        OSError: the system cannot do it.
    """
    every = READ_FILE | REFER if version() > 1 else READ_FILE
    ruleset = _Ruleset(every, CONNECT_TCP if alone else 0)
    known = ctypes.sizeof(ruleset) if version() >= 4 else ctypes.sizeof(ctypes.c_uint64)  # of the fields, in bytes
    rules = _call(CREATE_RULESET, ctypes.byref(ruleset), known, 0)
    for path in beside(folder.resolve()):
        if path.is_symlink():  # it leads to what has a rule of its own, or to the folder
            continue
        try:
            at = os.open(path, os.O_PATH | os.O_CLOEXEC)
        except FileNotFoundError:  # gone in between
            continue
        rule = _Beneath(every if path.is_dir() else READ_FILE, at)
        _call(ADD_RULE, rules, PATH_BENEATH, ctypes.byref(rule), 0)
        os.close(at)
    ctypes.CDLL(None).prctl(NO_NEW_PRIVS, 1, 0, 0, 0)
    _call(RESTRICT_SELF, rules, 0)


if __name__ == "__main__":
    ctypes.CDLL(None).prctl(PDEATHSIG, signal.SIGKILL, 0, 0, 0)
    if sys.argv[1]:
        hide(Path(sys.argv[1]), bool(sys.argv[2]))
    try:
        os.execvp(sys.argv[3], sys.argv[3:])
    except OSError as error:
        sys.exit(f"{sys.argv[3]}: {error.strerror}")
