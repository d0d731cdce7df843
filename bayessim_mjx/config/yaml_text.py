"""YAML as plain values, from files that may be anybody's: nothing in them runs, reads the environment or grows.

`${section.key}` stands for another number or text of the file. Resolvers (`${oc.env:HOME}` and the like) are refused.
"""

import re
import stat
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from bayessim_mjx.errors import UserError

DEPTH = 50  # sections within sections
NODES = 10**6  # values of a file, with what its aliases repeat
BYTES = 10**6
TEXT = 10_000  # characters of a text with references in it
CHAIN = 20  # references that refer to references
REFERENCE = re.compile(r"\$\{([^${}:\s]+)\}")


def read_yaml(path: str | Path) -> dict[str, Any]:
    """Read a YAML file as nested dicts; every way it can be broken is one UserError with file and line."""
    raw = _parsed(_text(path), str(path))
    if not isinstance(raw, dict):
        raise UserError(f"{path}: expected sections of `key: value` lines, found a {type(raw).__name__}")
    return _expanded(raw, raw, str(path))


def _text(path: str | Path) -> str:
    try:
        if not stat.S_ISREG(Path(path).stat().st_mode):  # a pipe or a device may never end
            raise UserError(f"{path}: cannot be read: not a file")
        with open(path, "rb") as file:
            content = file.read(BYTES + 1)
        if len(content) > BYTES:
            raise UserError(f"{path}: larger than {BYTES // 10**6} MB; settings are short texts")
        return content.decode("utf-8")
    except UserError:
        raise
    except UnicodeDecodeError as error:
        raise UserError(f"{path}: not valid YAML: {error}") from None
    except (OSError, ValueError) as error:
        raise UserError(f"{path}: cannot be read: {getattr(error, 'strerror', None) or error}") from None


def read_value(text: str, source: str) -> Any:
    """Read the value of a short YAML text, such as `[1, 2]`, on the command line.

    Raises:
        UserError: it is no YAML, or holds `${...}`, which only files may.
    """
    if "${" in text:
        raise UserError(f"{source}: ${{...}} is not expanded on the command line; write the value itself")
    values = _parsed("- " + text, source, what="the value is ")
    if not isinstance(values, list) or len(values) != 1:
        raise UserError(f"{source}: the value is not valid YAML: one value is expected")
    return values[0]


def to_yaml(plain: Mapping[str, Any]) -> str:
    """YAML text that `read_yaml` reads back exactly."""
    from omegaconf import OmegaConf

    return OmegaConf.to_yaml(OmegaConf.create(dict(plain)))


def _parsed(text: str, source: str, what: str = "") -> Any:
    """Plain values, references as they stand."""
    import yaml
    from omegaconf import OmegaConf
    from omegaconf.errors import OmegaConfBaseException

    try:
        _refuse_growth(yaml.compose(text, Loader=yaml.SafeLoader), source)
        made = OmegaConf.create(text)
        return OmegaConf.to_container(made) if OmegaConf.is_config(made) else made
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        line = f", line {mark.line + 1}" if mark and not what else ""
        raise UserError(f"{source}{line}: {what}not valid YAML: {_problem(error)}") from None
    except (OmegaConfBaseException, ValueError) as error:
        if isinstance(error, UserError):
            raise
        raise UserError(f"{source}: {what}not valid YAML: {str(error).splitlines()[0]}") from None
    except RecursionError:
        raise _too_deep(source) from None


def _problem(error: Exception) -> str:
    return str(getattr(error, "problem", None) or error).splitlines()[0]


def _too_deep(source: str) -> UserError:
    return UserError(f"{source}: sections nested more than {DEPTH} deep")


def _refuse_growth(root: Any, source: str) -> None:
    """Refuse nodes nested too deep, in a circle, or too many of them once aliases are written out."""
    import yaml

    sizes: dict[int, int] = {}

    def size(node: Any, depth: int) -> int:
        if depth > DEPTH:
            raise _too_deep(source)
        if id(node) not in sizes:
            below = node.value if isinstance(node, yaml.CollectionNode) else ()
            parts = [n for pair in below for n in (pair if isinstance(pair, tuple) else (pair,))]
            sizes[id(node)] = 1 + sum(size(part, depth + 1) for part in parts)
        return sizes[id(node)]

    if root is not None and size(root, 0) > NODES:
        raise UserError(f"{source}: more than {NODES} values, by its aliases; write them out or use fewer")


def _expanded(node: Any, root: Mapping[str, Any], source: str) -> Any:
    """Replace references in the values by what they stand for."""
    if isinstance(node, dict):
        for key in node:
            if isinstance(key, str) and "${" in key:
                raise UserError(f"{source}: key {key!r}: references are values, not keys")
        return {key: _expanded(value, root, source) for key, value in node.items()}
    if isinstance(node, list):
        return [_expanded(value, root, source) for value in node]
    return _referred(node, root, source, 0) if isinstance(node, str) and "${" in node else node


def _referred(text: str, root: Mapping[str, Any], source: str, chain: int) -> Any:
    if chain > CHAIN:
        raise UserError(f"{source}: {text!r}: references in a circle")
    rest = REFERENCE.sub("", text)
    if "${" in rest:
        raise UserError(
            f"{source}: {text!r}: only references such as ${{section.key}} are expanded, no resolvers (${{name:...}})"
        )

    def value(path: str) -> Any:
        found = _at(root, path, source)
        return _referred(found, root, source, chain + 1) if isinstance(found, str) and "${" in found else found

    whole = REFERENCE.fullmatch(text)
    if whole:
        return value(whole[1])
    said: Callable[[re.Match], str] = lambda match: str(value(match[1]))  # noqa: E731
    joined = REFERENCE.sub(said, text)
    if len(joined) > TEXT:
        raise UserError(f"{source}: {text[:60]!r}: its references make more than {TEXT} characters of it")
    return joined


def _at(root: Mapping[str, Any], path: str, source: str) -> Any:
    """Get the number or text at `a.b.0`."""
    node: Any = root
    for part in path.split("."):
        if isinstance(node, list) and re.fullmatch("[0-9]{1,9}", part) and int(part) < len(node):
            node = node[int(part)]
        elif isinstance(node, dict) and part in node:
            node = node[part]
        else:
            raise UserError(f"{source}: ${{{path}}}: there is no {path} in the file")
    if isinstance(node, dict | list):
        raise UserError(f"{source}: ${{{path}}}: {path} is a section or a list; references stand for numbers and texts")
    return node
