"""Docstrings on the site: `<name>` outside of code is text, no HTML element. An extension of Griffe (mkdocs.yml)."""

import re
from typing import Any

import griffe

CODE = re.compile(r"(```.*?```|`[^`\n]*`)", re.DOTALL)


class Brackets(griffe.Extension):
    def on_object(self, *, obj: griffe.Object, **_: Any) -> None:
        if obj.docstring:
            parts = CODE.split(obj.docstring.value)
            obj.docstring.value = "".join(p if k % 2 else re.sub(r"<(?=\w)", "&lt;", p) for k, p in enumerate(parts))
