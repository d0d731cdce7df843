"""Sound inputs of every kind, and how something in them is made wrong by chance."""

import functools
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

Case = tuple[str, Callable[[], Any]]


JUNK = (
    "", " ", "nan", "inf", "-inf", ".nan", ".inf", "1e400", "-1", "0", "-0.0", "1e-320", "99999999999999999999", "1e12",
    "3.7", "true", "no", "null", "~", "[]", "{}", "[1, 2", "{a: 1", "!!python/object/apply:os.abort []", "&a [*a]",
    "*b", "${oc.env:HOME}", "${task}", "../../etc/passwd", "/etc/passwd", "/", "\u0661", "\u00e9\U0001f600", "\x00",
    "\x1b[2J", "a" * 300, "0x1F", "1_000", "[" * 2000, "2020-01-01", "'", '"', "- -", "*", "path.py:Class", "Pendulum",
    "best", "1e3", "1e30", "-5e-3", "[0, 1]", "[1, 0]",
)  # fmt: skip


ARM = """<mujoco model="arm">
  <compiler angle="radian"/>
  <option timestep="0.005" integrator="Euler" gravity="0 0 -9.81"/>
  <worldbody>
    <body name="upper" pos="0 0 1">
      <joint name="shoulder" type="hinge" axis="0 1 0" damping="0.1" range="-3 3" limited="true"/>
      <geom name="rod" type="capsule" fromto="0 0 0 0 0 -.3" size=".02" mass="1" contype="0" conaffinity="0"/>
      <body name="lower" pos="0 0 -.3"><joint name="elbow" type="hinge" axis="0 1 0" armature="0.01"/>
        <geom type="capsule" fromto="0 0 0 0 0 -.3" size=".02" mass=".5" contype="0" conaffinity="0"/></body>
    </body>
  </worldbody>
  <actuator><motor name="m" joint="shoulder" gear="2" ctrlrange="-2 2" ctrllimited="true"/>
    <position name="p" joint="elbow" kp="5" kv=".1"/></actuator>
</mujoco>"""


SIDE = """condition: cold
controller: {p: {law: position, kp: 3, limit: 2.0}}
repeat_of: run.csv
sigma: {elbow: 0.01}
quantum: {"qpos:shoulder": 0.001}
"""


MAP = """files: "*.csv"
delimiter: ","
header: true
time: {column: time, scale: 1.0}
ctrl: {m: "ctrl:m", p: {column: "ctrl:p", sign: -1, offset: 0.1}}
qpos: {shoulder: {column: "qpos:shoulder", signed: 16, wrap: 6.283}, elbow: {value: 0.0}}
streams: {temperature: 5}
metadata: {operating_condition: bench}
"""


PARAMS = """task:
  randomize: true
  randomization_params:
    actor_params:
      robot:
        dof_properties:
          damping: {range: [0.5, 2.0], operation: scaling, distribution: uniform, include: shoulder}
        rigid_body_properties:
          mass: {range: [0.8, 1.2], operation: scaling, distribution: loguniform}
"""


EFFECTS = """schema: 1
effects:
- effect: coulomb_friction
  where: hinge
  parameters: {level: {range: [0.0, 0.2], nominal: 0.05}}
calibrated: []
"""


def junk(rng: np.random.Generator) -> str:
    return JUNK[rng.integers(len(JUNK))]


def choice(rng: np.random.Generator, items: Sequence[Any]) -> Any:
    return items[int(rng.integers(len(items)))]


@functools.cache
def arm() -> Any:
    import mujoco

    return mujoco.MjModel.from_xml_string(ARM)


def table(rows: int = 60) -> np.ndarray:
    """time, two commands, two angles, a temperature."""
    t = 0.01 * np.arange(rows)
    return np.stack([t, np.sin(5 * t), 0.3 * np.cos(t), 0.5 * np.sin(3 * t), 0.2 * np.cos(2 * t), 20 + t], 1)


HEADER = "time,ctrl:m,ctrl:p,qpos:shoulder,qpos:elbow,temperature"


def bytes_changed(rng: np.random.Generator, data: bytes) -> tuple[str, bytes]:
    """Flipped, cut, doubled or foreign bytes."""
    at, much = int(rng.integers(max(len(data), 1))), bytearray(data)
    how = choice(rng, ("flip", "cut", "double", "insert", "utf-16", "empty", "bom"))
    if how == "flip":
        for i in rng.integers(max(len(data), 1), size=5):
            if len(much):
                much[i] ^= int(rng.integers(1, 256))
    elif how == "insert":
        much[at:at] = rng.bytes(8)
    changed = {
        "flip": bytes(much), "cut": data[:at], "double": data[:at] + data, "insert": bytes(much), "empty": b"",
        "utf-16": data.decode("latin-1").encode("utf-16"), "bom": b"\xef\xbb\xbf" + data,
    }[how]  # fmt: skip
    return f"bytes: {how}", changed


def text_changed(rng: np.random.Generator, text: str) -> tuple[str, str]:
    """One token of a text replaced by junk, or a line lost, doubled, indented or moved."""
    tokens = [m.span() for m in re.finditer(r"[\w.:+-]+", text)]
    lines = text.splitlines()
    numbers = [(a, b) for a, b in tokens if re.fullmatch(r"[-+]?[\d.]+(e-?\d+)?", text[a:b])] or tokens
    i, value = int(rng.integers(len(lines))), junk(rng)
    a, b = choice(rng, numbers if rng.random() < 0.5 else tokens)
    how = choice(rng, ("token", "token", "token", "key", "lost", "doubled", "indented", "moved"))
    if how == "token":
        return f"{text[a:b]!r} -> {value[:40]!r}", text[:a] + value + text[b:]
    if how == "key":
        return f"{text[a:b]!r} misspelt", text[: b - 1] + "q" + text[b - 1 :]
    changed = {
        "lost": lines[:i] + lines[i + 1 :],
        "doubled": lines[: i + 1] + lines[i:],
        "indented": [*lines[:i], " " + lines[i], *lines[i + 1 :]],
        "moved": lines[i:] + lines[:i],
    }[how]
    return f"line {i + 1} {how}", "\n".join(changed) + "\n"


def file_changed(rng: np.random.Generator, path: Path, text: str) -> str:
    """Write `text` with something wrong in it; what."""
    if rng.random() < 0.15:
        what, data = bytes_changed(rng, text.encode())
    else:
        what, changed = text_changed(rng, text)
        data = changed.encode("utf-8", "surrogateescape")
    path.write_bytes(data)
    return what


def box(space: Any) -> None:
    assert np.isfinite(space.low).all() and np.isfinite(space.high).all() and (space.low < space.high).all(), "no box"
