"""Make the pictures of README and docs from small real runs, into docs/pictures.

    python docs/make_pictures.py [--work DIR] [--only loop diagnosis]

Runs `main --task Pendulum`, the first command of README, and `diagnose` on the logs of examples/diagnose_pendulum.py,
each in a pseudo-terminal (Linux, macOS), about ten minutes together on two cores. What is already in --work is not run
again.

- loop.svg, diagnosis.svg: the terminal, by rich's export
- posterior.png: the corner plot of the last round
- pendulum.gif: the policy of the best round, by `play --video`; left out with a reason where nothing can be drawn
- report.html: the report, with its plotting library beside it instead of inside (the site adds plotly.min.js)
- report.png: the head of report.html, by a headless Chromium or Chrome; left out with a reason where there is none
"""

import argparse
import fcntl
import importlib.util
import io
import os
import pty
import re
import shutil
import struct
import subprocess
import sys
import tempfile
import termios
from itertools import groupby
from pathlib import Path

from rich.console import Console
from rich.terminal_theme import TerminalTheme
from rich.text import Text

ROOT = Path(__file__).resolve().parents[1]
ROWS, COLUMNS = 60, 100
BROWSERS = ("chromium", "chromium-browser", "google-chrome", "chrome")
WINDOW = "1180,1260"  # of the browser
LARGEST = {".svg": 200_000, ".png": 200_000, ".gif": 1_000_000, ".html": 300_000}  # bytes of a picture
PLOTLY = re.compile(r"<script>/\*\*\s*\* plotly\.js.*?</script>", re.DOTALL)
GIF = "fps=15,scale=240:-1:flags=lanczos,split[a][b];[a]palettegen=max_colors=64[p];[b][p]paletteuse=dither=none"
PLAY = "play --task Pendulum --checkpoint best --video"
LOOP = "main --task Pendulum"
DIAGNOSIS = "diagnose --task Pendulum --data motion --accuracy 5% --out found"
EFFECTS = "coulomb_friction,viscous_friction,actuator_gain,actuator_delay,joint_offset"
DARK = [(40, 42, 46), (179, 38, 30), (46, 125, 50), (160, 106, 0), (21, 101, 192), (123, 31, 162), (0, 121, 107)]
THEME = TerminalTheme((250, 250, 248), (40, 42, 46), [*DARK, (110, 110, 110)], [(110, 110, 110), *DARK[1:], DARK[0]])


def in_terminal(words: list[str], work: Path, name: str) -> str:
    """Run `python -m bayessim_mjx.<words>` in a pseudo-terminal, from the folder `work`.

    Returns what it wrote to the terminal, control characters included; it is also kept in `<work>/<name>.txt`.
    """
    log, errors = work / f"{name}.txt", work / f"{name}.errors.txt"
    if log.exists():
        return log.read_bytes().decode()
    main, child = pty.openpty()
    fcntl.ioctl(child, termios.TIOCSWINSZ, struct.pack("HHHH", ROWS, COLUMNS, 0, 0))
    environment = os.environ | {"TERM": "xterm-256color", "PYTHONPATH": str(ROOT), "COLUMNS": str(COLUMNS)}
    command = [sys.executable, "-m", f"bayessim_mjx.{words[0]}", *words[1:]]
    with errors.open("wb") as file:  # the compiler's complaints about slow machines are no part of the picture
        running = subprocess.Popen(command, stdin=child, stdout=child, stderr=file, env=environment, cwd=work)
        os.close(child)
        text = b"".join(iter(lambda: _read(main), b""))
    if code := running.wait():
        sys.exit(f"{' '.join(command)} ended with exit code {code}: see {errors}")
    log.write_bytes(text)
    return text.decode()


def _read(main: int) -> bytes:
    """Read what there is; empty at the end, which Linux tells by an error."""
    try:
        return os.read(main, 65536)
    except OSError:
        return b""


class Screen:
    """The lines of a terminal after control sequences: those that rich writes, and no others."""

    SEQUENCE = re.compile(r"\x1b\[([?\d;]*)([A-Za-z])")

    def __init__(self) -> None:
        self.lines: list[list[tuple[str, str]]] = [[]]  # (style, character)
        self.row = self.column = 0
        self.style = ""

    def write(self, text: str) -> None:
        at = 0
        while at < len(text):
            if found := self.SEQUENCE.match(text, at):
                self._control(*found.groups())
                at = found.end()
            else:
                self._put(text[at])
                at += 1

    def _control(self, numbers: str, kind: str) -> None:
        if kind == "m":
            self.style = "" if numbers in ("", "0") else f"{self.style}\x1b[{numbers}m"
        elif kind == "A":
            self.row = max(self.row - int(numbers or 1), 0)
        elif kind == "K":
            self.lines[self.row] = []

    def _put(self, character: str) -> None:
        if character == "\n":
            self.row += 1
            self.lines += [[] for _ in range(self.row + 1 - len(self.lines))]
        elif character == "\r":
            self.column = 0
        elif character >= " ":
            line = self.lines[self.row]
            line += [("", " ")] * (self.column + 1 - len(line))
            line[self.column] = (self.style, character)
            self.column += 1

    def texts(self) -> list[Text]:
        """List the lines with their styles, without empty ones at the end."""
        found = []
        for line in self.lines:
            parts = ((style, "".join(c for _, c in run)) for style, run in groupby(line, key=lambda cell: cell[0]))
            found.append(Text.from_ansi("".join(f"\x1b[0m{style}{part}" for style, part in parts)))
        while found and not found[-1].plain.strip():
            found.pop()
        return found


def terminal_picture(text: str, title: str, out: Path) -> None:
    """Draw the last state of a terminal as SVG, with the viewer's own monospaced font."""
    screen = Screen()
    screen.write(text)
    console = Console(record=True, width=COLUMNS, file=io.StringIO())
    for line in screen.texts():
        console.print(line, soft_wrap=True)
    console.print()  # the picture ends within its last line
    svg = console.export_svg(title=f"bayessim-mjx {title}", theme=THEME, unique_id=out.stem)
    out.write_text(re.sub(r"@font-face {.*?}\s*", "", svg, flags=re.DOTALL))


def loop_pictures(work: Path, out: Path) -> None:
    text = in_terminal(LOOP.split(), work, "loop")
    terminal_picture(text, LOOP, out / "loop.svg")
    corners = sorted(work.glob("logs/Pendulum/*/pictures/BayesSim_posterior_0*.png"))
    shutil.copyfile(corners[-1], out / "posterior.png")
    in_terminal(PLAY.split(), work, "play")
    films = sorted(work.glob("logs/Pendulum/*/videos/play/*.mp4"))
    if not films:
        print(f"pendulum.gif: left out, see {work / 'play.txt'}")
        return
    import imageio_ffmpeg

    encoder = [
        imageio_ffmpeg.get_ffmpeg_exe(),
        "-y",
        "-i",
        str(films[-1]),
        "-t",
        "4",
        "-filter_complex",
        GIF,
        "-loop",
        "0",
    ]
    subprocess.run([*encoder, str(out / "pendulum.gif")], check=True, capture_output=True)


def record_motion(folder: Path) -> None:
    """Record the logs of examples/diagnose_pendulum.py."""
    place = importlib.util.spec_from_file_location("example", ROOT / "examples" / "diagnose_pendulum.py")
    assert place is not None and place.loader is not None
    example = importlib.util.module_from_spec(place)
    place.loader.exec_module(example)
    plain = example.registry.make("Pendulum", config=example.load("Pendulum", overrides=["task.randomize=False"]))
    example.record(example.real_pendulum(plain), plain.dt, folder)


def diagnosis_pictures(work: Path, out: Path) -> None:
    if not (work / "motion").exists():
        record_motion(work / "motion")
    text = in_terminal([*DIAGNOSIS.split(), "--effects", EFFECTS], work, "diagnosis")
    terminal_picture(text, f"{DIAGNOSIS} --effects LIST", out / "diagnosis.svg")
    report = (work / "found" / "report.html").read_text(encoding="utf-8")
    small = PLOTLY.sub('<script src="plotly.min.js"></script>', report)
    (out / "report.html").write_text(small.replace("which is inside this file", "and plotly.min.js"), encoding="utf-8")
    browser = next((path for name in BROWSERS if (path := shutil.which(name))), None)
    if browser is None:
        print(f"report.png: left out, there is no {', '.join(BROWSERS)}")
        return
    page, picture = (work / "found" / "report.html").resolve(), (out / "report.png").resolve()
    flags = ["--headless=new", "--no-sandbox", "--disable-gpu", "--hide-scrollbars", f"--window-size={WINDOW}"]
    command = [browser, *flags, "--virtual-time-budget=5000", f"--screenshot={picture}", page.as_uri()]
    subprocess.run(command, check=True, capture_output=True)
    from PIL import Image

    # text and bars have few colours; a median cut loses those of small squares
    few = Image.open(picture).convert("RGB").quantize(128, method=Image.Quantize.MAXCOVERAGE)
    few.save(picture, optimize=True)


PICTURES = {"loop": loop_pictures, "diagnosis": diagnosis_pictures}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--work", type=Path, help="folder of the runs (default: a temporary one)")
    parser.add_argument("--out", type=Path, default=ROOT / "docs" / "pictures", help="folder of the pictures")
    parser.add_argument("--only", nargs="+", choices=list(PICTURES), default=list(PICTURES))
    args = parser.parse_args()
    work = args.work or Path(tempfile.mkdtemp(prefix="pictures_"))
    for folder in (work, args.out):
        folder.mkdir(parents=True, exist_ok=True)
    for name in args.only:
        PICTURES[name](work, args.out)
    for picture in sorted(p for p in args.out.iterdir() if p.is_file()):
        size = picture.stat().st_size
        large = " (too large)" if size > LARGEST[picture.suffix] else ""
        print(f"{picture}: {size / 1000:.0f} kB{large}")


if __name__ == "__main__":
    main()
