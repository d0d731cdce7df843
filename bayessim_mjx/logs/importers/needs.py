"""Packages of the extra `[logs]`, imported where they are needed."""

from __future__ import annotations

from importlib import import_module
from typing import Any

from bayessim_mjx.errors import UserError


def needs(module: str, command: str, package: str) -> Any:
    """Import a module of an optional package.

    Raises:
        UserError: its package is not installed.
    """
    try:
        return import_module(module)
    except ImportError as error:
        raise UserError(f"{command} needs the package {package}: pip install 'bayessim-mjx[logs]' ({error})") from None
