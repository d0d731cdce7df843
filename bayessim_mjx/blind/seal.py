"""Sealed truths: what is hidden in a case lies apart from its logs, which carry only a SHA-256 of it."""

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from bayessim_mjx import atomic
from bayessim_mjx.errors import UserError

SEAL = "seal.txt"


def digest(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()


def files_of(folder: Path) -> dict[str, str]:
    """{path: SHA-256} of what a diagnosis is given."""
    files = (p for p in sorted(folder.rglob("*")) if p.is_file())
    return {p.relative_to(folder).as_posix(): digest(p.read_bytes()) for p in files}


def close(truth: Mapping[str, Any], given: Path, secret: Path) -> str:
    """Write a truth, with the hashes of the files in `given`, to `secret`; the seal, which is its SHA-256."""
    text = json.dumps({**truth, "files": files_of(given)}, indent=1, default=float)
    secret.parent.mkdir(parents=True, exist_ok=True)
    atomic.write_text(secret, text)
    secret.chmod(0o600)
    return digest(text.encode())


def opened(given: Path, secret: Path, seals: Mapping[str, str]) -> dict[str, Any]:
    """Open the truth behind a seal.

    Args:
        given: the folder that a diagnosis got; secret: the file of the truth.
        seals: {where it stands: seal}; all have to agree with the truth.

    Raises:
        UserError: truth, logs or a seal are not those that were sealed.
    """
    data = secret.read_bytes()
    for place, seal in seals.items():
        if digest(data) != seal:
            raise UserError(f"{secret}: this is not the truth that {place} was sealed with; make the case again")
    truth = json.loads(data)
    if files_of(given) != truth["files"]:
        raise UserError(f"{given}: these are not the files that were sealed; make the case again")
    return truth
