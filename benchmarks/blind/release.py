"""The count of a release: fresh cases of the blind suite, every entry, and the leaderboard with what it was made with.

    python benchmarks/blind/release.py --out FOLDER --seeds 2000:2010

Refuses a tree with changes that are not committed, seeds of development, and seeds that an earlier release has counted.
Writes leaderboard.json (commit, seeds, versions, figures) beside this file and the table into docs/leaderboard.md.
"""

import argparse
import json
import subprocess
import sys
from pathlib import Path

from kinds import KINDS, VERSION
from suite import COUNTED, ENTRIES, enter, generate, table, unfinished
from systems import SYSTEMS

from bayessim_mjx import pool
from bayessim_mjx.versions import versions

HERE = Path(__file__).resolve().parent
ROOT = HERE.parents[1]
RECORD, PAGE = HERE / "leaderboard.json", ROOT / "docs" / "leaderboard.md"
BEGIN, END = "<!-- leaderboard: begin -->", "<!-- leaderboard: end -->"


def git(*words: str) -> str:
    return subprocess.run(["git", "-C", str(ROOT), *words], capture_output=True, text=True, check=True).stdout.strip()


def refused(seeds: range, counted: list[dict]) -> str:
    """Why nothing is counted, or ""."""
    if changed := git("status", "--porcelain"):
        return f"the tree has changes that are not committed:\n{changed}"
    if seeds.start < COUNTED:
        return f"--seeds {seeds.start}:{seeds.stop}: seeds below {COUNTED} are for development"
    for release in counted:
        first, last = release["seeds"]
        if seeds.start < last and first < seeds.stop and release["commit"] != git("rev-parse", "HEAD"):
            return f"--seeds {seeds.start}:{seeds.stop}: commit {release['commit'][:9]} has counted {first}:{last}"
    return ""


def lacking() -> str:
    """What an entry lacks on this machine, or "": it would count as one that never answers."""
    from mujoco import sysid

    if not hasattr(sysid, "optimize"):
        return 'the parameter refit lacks its package: pip install "mujoco[sysid]"'
    if not (HERE / "entries" / "classifier.npz").exists():
        return "the classifier is not trained: entries/classifier.py --train SUITE, on development seeds"
    return ""


def written(page: str, text: str) -> str:
    """The page with another text between its marks."""
    before, _, rest = page.partition(BEGIN)
    return f"{before}{BEGIN}\n\n{text}\n\n{END}{rest.partition(END)[2]}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True, help="folder of cases and answers; goes on where it stopped")
    parser.add_argument("--seeds", required=True, help="first:last, last not included")
    parser.add_argument("--systems", default="pendulum,two_link", help=f"of {', '.join(SYSTEMS)}")
    parser.add_argument("--workers", type=int, help="cases at a time (default: as many as cores)")
    parser.add_argument("--cluster", **pool.CLUSTER)
    args = parser.parse_args()
    first, last = (int(n) for n in args.seeds.split(":"))
    counted = json.loads(RECORD.read_text()) if RECORD.exists() else []
    if why := refused(range(first, last), counted) or lacking():
        sys.exit(why)
    systems = args.systems.split(",")
    generate(args.out, range(first, last), systems, list(KINDS))
    for name, command in ENTRIES.items():
        enter(args.out, name, command, args.workers, 3600.0, args.cluster)
    if left := sum(len(unfinished(args.out, name)) for name in ENTRIES):
        sys.exit(f"{left} answers are missing, as they were stopped: start it again")
    text, figures = table(args.out)
    release = {"suite": VERSION, "commit": git("rev-parse", "HEAD"), "seeds": [first, last], "systems": systems}
    counted = [c for c in counted if c["commit"] != release["commit"]]
    RECORD.write_text(json.dumps([*counted, release | {"versions": versions(), "figures": figures}], indent=1) + "\n")
    caption = f"Suite {VERSION}, commit {release['commit'][:9]}, seeds {first} to {last - 1}, {', '.join(systems)}."
    PAGE.write_text(written(PAGE.read_text(), f"{text}\n\n{caption}"))
    print(text)


if __name__ == "__main__":
    main()
