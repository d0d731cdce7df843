"""The tasks. Their files stand in tasks/ at the top of a checkout, here in a wheel."""

from pathlib import Path

_checkout = Path(__file__).resolve().parents[2]
if (_checkout / "pyproject.toml").is_file():
    __path__.append(str(_checkout / "tasks"))
