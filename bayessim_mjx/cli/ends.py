"""How a command ends: its exit code, and one line or a traceback on stderr."""

import os
import sys
import traceback
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from bayessim_mjx.errors import UserError, out_of_memory, refused

DEBUG_VARIABLE = "BAYESSIM_MJX_DEBUG"  # set: errors come with a traceback
BUGS = "to the issue tracker of bayessim_mjx"
OPENGL = "MUJOCO_GL"  # MuJoCo loads the OpenGL library of this name when it is imported
LIBRARIES = "egl (Debian: libegl1), osmesa (libosmesa6), glfw (libglfw3, with a screen), or disable (no video)"


CLOSED = 141  # exit code of what writes to a closed pipe, as shells give it: 128 + SIGPIPE


class Piped:
    """A stream whose reader may go, as in `... | head`: what follows is dropped, and the command ends its work."""

    def __init__(self, stream: Any) -> None:
        self.stream, self.left = stream, False

    def __getattr__(self, name: str) -> Any:
        return getattr(self.stream, name)

    def write(self, text: str) -> int:
        return self._through(lambda: self.stream.write(text), len(text))

    def flush(self) -> None:
        self._through(self.stream.flush, None)

    def _through(self, do: Callable[[], Any], instead: Any) -> Any:
        try:
            return do()
        except BrokenPipeError:
            self.left = True
            os.dup2(os.open(os.devnull, os.O_WRONLY), self.stream.fileno())
            return instead


def command(run: Callable[[Sequence[str] | None], int]) -> Callable[..., int]:
    """Return a `main(argv=None)` that returns an exit code.

    0; 2 and one line on stderr for what the user can mend; 1 and a traceback for a bug; 130 after Ctrl-C; 141 in place
    of 0 where nobody read on.
    """

    def main(argv: Sequence[str] | None = None) -> int:
        before = sys.stdout, sys.stderr
        piped = Piped(sys.stdout), Piped(sys.stderr)
        sys.stdout, sys.stderr = piped
        try:
            code = ended(argv)
            for stream in piped:
                stream.flush()
            return code or (CLOSED if any(stream.left for stream in piped) else 0)
        finally:
            sys.stdout, sys.stderr = before

    def ended(argv: Sequence[str] | None) -> int:
        try:
            return run(argv)
        except KeyboardInterrupt:
            return 130
        except SystemExit as end:  # --help
            if end.code in (None, 0):
                return 0
            return _bug()
        except Exception as error:
            if os.environ.get(DEBUG_VARIABLE):
                raise
            if not isinstance(error, UserError) and not refused(error) and not no_opengl(error):
                return _bug()
            print(f"error: {no_opengl(error) or one_line(error)}", file=sys.stderr)
            return 2

    main.__doc__ = run.__doc__
    return main


def one_line(error: Exception) -> str:
    """Return the message without line ends; where memory was short, with the settings to lower."""
    text = " ".join(str(error).split("\n"))
    if not out_of_memory(error):
        return text
    return f"{text.rstrip('. ') or 'out of memory'}; lower env.numEnvs, ppo.num_steps or bayessim.trainTrajs"


def no_opengl(error: BaseException) -> str:
    """Return the message where MuJoCo cannot load the OpenGL library that MUJOCO_GL names; "" for any other error."""
    chosen = os.environ.get(OPENGL, "")
    files = (Path(frame.f_code.co_filename).parts for frame, _ in traceback.walk_tb(error.__traceback__))
    if not chosen or not any(parts[-1] == "gl_context.py" and "mujoco" in parts for parts in files):
        return ""
    return f"{OPENGL}={chosen}: OpenGL cannot be loaded; allowed: {LIBRARIES}; install it, choose another, or unset it"


def _bug() -> int:
    """Print the traceback of the present error, and where to report it."""
    traceback.print_exc()
    print(f"\nThis is a bug: please report it with the lines above and your command, {BUGS}", file=sys.stderr)
    return 1
