"""Whose code runs: files of code that the user names on the command line or in a program, never one that data name.

Settings files, run folders, effects.yaml and diagnosis.json may come from anybody; see docs/trust.md.
"""

import functools
import os
import shlex
import sys
from collections.abc import Iterable
from pathlib import Path
from types import ModuleType

from bayessim_mjx.errors import UserError

FLAG = "--allow_code"
_named: set[Path] = set()


def allow(files: Iterable[str | os.PathLike]) -> None:
    """Files whose code may run in this process, whoever names them."""
    _named.update(Path(file).expanduser().resolve() for file in files)


def flags() -> str:
    """Write flags that allow the same files in another command: " --allow_code reach.py"; "" for none."""
    return "".join(f" {FLAG} {shlex.quote(str(file))}" for file in sorted(_named))


def check(file: Path, spec: str, what: str = "effect") -> None:
    """UserError where the user has not named `file`, which a settings file names as the `what` called `spec`."""
    if file.resolve() not in _named:
        raise UserError(
            f"{what} {spec!r}: settings name code of yours, which runs only where you name it too; read {file}, then "
            f"give {FLAG} {file} (docs/trust.md)"
        )


def module_of(path: Path, title: str, what: str, package: str) -> ModuleType:
    """Import a user's file as a module; one for each file as it is now, so that equal classes are equal.

    Args:
        path: the file; title: the class that is wanted of it, for messages; what: "effect", "task".
        package: the module's name is `<package>.own_<file>_<digest>`.

    Raises:
        UserError: no such file, the user has not named it, or it fails, then with its line.
    """
    if not path.is_file():
        raise UserError(f"{what} {path}:{title}: no file {path} (from {Path.cwd()})")
    check(path, f"{path}:{title}", what)
    path = path.resolve()
    return _executed(path, path.stat().st_mtime_ns, package)


@functools.cache
def _executed(path: Path, changed: int, package: str) -> ModuleType:
    import hashlib  # here, so that commands start fast
    import importlib.util

    name = f"{package}.own_{path.stem}_{hashlib.sha1(f'{path}{changed}'.encode()).hexdigest()[:8]}"
    spec = importlib.util.spec_from_file_location(name, path)
    assert spec is not None and spec.loader is not None
    module = sys.modules[name] = importlib.util.module_from_spec(spec)
    try:
        spec.loader.exec_module(module)
    except (Exception, SystemExit) as error:
        del sys.modules[name]
        raise UserError(f"{path}{line_of(error, path)}: {type(error).__name__}: {error}") from error
    return module


def line_of(error: BaseException, path: Path) -> str:
    """Where in the user's file it went wrong, as ", line 3 in `reward`"; empty where the file has no part in it."""
    import traceback

    frames = [f for f in traceback.extract_tb(error.__traceback__) if f.filename == str(path)]
    line = error.lineno if isinstance(error, SyntaxError) else frames[-1].lineno if frames else None
    methods = [f.name for f in frames if not f.name.startswith("<")]  # outside of functions: <module>
    return (f", line {line}" if line else "") + (f" in `{methods[0]}`" if methods else "")
