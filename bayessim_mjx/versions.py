"""Versions of what decides results: this package, Python, the packages below, and the checkout's commit."""

import platform
import subprocess
from importlib import metadata
from pathlib import Path
from typing import Any

PACKAGES = ("bayessim-mjx", "jax", "jaxlib", "mujoco", "mujoco-mjx", "numpy", "optax", "flax", "orbax-checkpoint")


def versions() -> dict[str, str]:
    """Python and the packages that decide results."""
    found = {"python": platform.python_version(), "platform": platform.platform()}
    for package in PACKAGES:
        try:
            found[package] = metadata.version(package)
        except metadata.PackageNotFoundError:
            continue
    return found


def git_state() -> dict[str, Any] | None:
    """Commit and whether anything is changed, of the checkout that this package runs from; None outside of one."""
    root = Path(__file__).resolve().parents[1]
    if not (root / ".git").exists():
        return None
    options: dict[str, Any] = {"capture_output": True, "text": True, "check": True, "timeout": 20}
    try:
        commit = subprocess.run(["git", "-C", str(root), "rev-parse", "HEAD"], **options).stdout
        status = subprocess.run(["git", "-C", str(root), "status", "--porcelain"], **options).stdout
    except (OSError, subprocess.SubprocessError):
        return None
    return {"commit": commit.strip(), "dirty": bool(status.strip())}
