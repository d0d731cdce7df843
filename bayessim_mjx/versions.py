"""Versions of what decides results: this package, Python, the packages below, and the checkout's commit."""

import functools
import hashlib
import platform
import subprocess
from collections.abc import Iterable
from importlib import metadata
from pathlib import Path
from typing import Any

PACKAGE = Path(__file__).resolve().parent
PACKAGES = ("bayessim-mjx", "jax", "jaxlib", "mujoco", "mujoco-mjx", "numpy", "optax", "flax", "orbax-checkpoint")


def versions() -> dict[str, str]:
    """Python and the packages that decide results."""
    found = {"python": platform.python_version(), "platform": platform.platform()}
    return found | {package: version for package in PACKAGES if (version := _version(package)) is not None}


@functools.cache
def sources(root: Path = PACKAGE) -> str:
    """SHA-256 of the package's Python files: what was computed by other code may differ, at the same version too."""
    found = hashlib.sha256()
    for path in sorted(root.rglob("*.py")):
        found.update(f"{path.relative_to(root).as_posix()}\0".encode() + path.read_bytes() + b"\0")
    return found.hexdigest()


def of(packages: Iterable[str]) -> dict[str, str]:
    """Versions of some packages; "unknown" of what is not installed, as of a checkout that is only on the path."""
    return {package: _version(package) or "unknown" for package in packages}


def _version(package: str) -> str | None:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return None


def git_state() -> dict[str, Any] | None:
    """Commit and whether anything is changed, of the checkout that this package runs from; None outside of one."""
    root = PACKAGE.parent
    if not (root / ".git").exists():
        return None
    options: dict[str, Any] = {"capture_output": True, "text": True, "check": True, "timeout": 20}
    try:
        commit = subprocess.run(["git", "-C", str(root), "rev-parse", "HEAD"], **options).stdout
        status = subprocess.run(["git", "-C", str(root), "status", "--porcelain"], **options).stdout
    except (OSError, subprocess.SubprocessError):
        return None
    return {"commit": commit.strip(), "dirty": bool(status.strip())}
