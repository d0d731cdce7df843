"""`bayessim-mjx policy check policy.onnx --logs DIR`: is the policy deployed as it was exported?"""

import json
import sys
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from bayessim_mjx import cli

DESCRIPTION = "Compare logs of a deployed policy with the file that was exported (docs/export.md)."
WIDTH = 120  # characters of a line where no terminal says it


def _parser() -> cli.PlainParser:
    prog = cli.prog_of("policy")
    parser = cli.PlainParser("policy", description=DESCRIPTION, usage="%(prog)s check FILE --logs DIR [options]")
    parts = parser.add_subparsers(dest="part", metavar="COMMAND", required=True, prog=prog)
    text = "order, signs, frames, scales, offsets, rates and delays of a deployed policy"
    check = parts.add_parser("check", help=text, description=f"Compare {text} with its file.")
    check.usage = f"{prog} check FILE --logs DIR [options]"
    check.add_argument("policy", metavar="FILE", help="ONNX file of bayessim-mjx play --export")
    check.add_argument("--logs", metavar="DIR", required=True, help="folder of logs, or one file")
    check.add_argument("--manifest", metavar="FILE", help="JSON file with fields in place of the policy's own")
    check.add_argument("--golden", metavar="FILE", help="JSON file with observation and action of the robot's computer")
    check.add_argument(
        "--model", metavar="FILE", help="MJCF or URDF model; it names the columns of qpos[0], qvel[0] ..."
    )
    cli.of_urdf(check)
    check.add_argument("--out", metavar="FILE", help="write the findings as JSON")
    return parser


def _policy(argv: Sequence[str] | None) -> int:
    """Compare logs of a deployed policy with its file; exit code 0 (right), 1 (not shown to be), 2 (bad input)."""
    args = _parser().parse_args(argv)
    if args.out:
        cli.writable(Path(args.out).parent, "--out")
    from bayessim_mjx.contract import words
    from bayessim_mjx.contract.check import check

    given, golden = (Path(path) if path else None for path in (args.manifest, args.golden))
    result = check(Path(args.policy), Path(args.logs), given, golden, _channels(args))
    _show(result)
    if args.out:
        Path(args.out).write_text(json.dumps(_facts(result), indent=1) + "\n", encoding="utf-8")
        print(f"written: {args.out}")
    return 0 if words.outcome(result) == "right" else 1


def _channels(args: Any) -> Any:
    if args.model is None:
        return None
    from bayessim_mjx.diagnosis.fitting import robot
    from bayessim_mjx.logs.log import Channels

    return Channels.of(robot.of_file(args.model, None, args.drive, args.packages).mj_model)


def _show(result: Any) -> None:
    """Print what differs, what is right, and what cannot be told."""
    from rich.console import Console
    from rich.table import Table

    from bayessim_mjx.contract import words
    from bayessim_mjx.quantities import listed

    console = Console(width=None if sys.stdout.isatty() else WIDTH)
    if result.findings:
        table = Table(box=None, pad_edge=False, header_style="bold")
        for title in ("where", "what differs", "error of its inputs: now, if mended"):
            table.add_column(title, overflow="fold")
        for finding in result.findings:
            table.add_row(words.where(finding), words.sentence(finding), words.evidence(finding))
        console.print(table)
        console.print()
    for part, names in result.compared.items():
        if names:
            console.print(f"right: {words.right(part, names)}", highlight=False)
    reasons: dict[str, list[str]] = {}
    for entry, reason in result.untold.items():
        reasons.setdefault(reason, []).append(entry)
    for reason, entries in reasons.items():
        console.print(f"unknown: {words.why(listed(entries, most=words.MOST), reason)}", highlight=False)
    for text in result.notes:
        console.print(f"note: {words.note(text)}", highlight=False)
    console.print(words.verdict(result), highlight=False)


def _facts(result: Any) -> dict[str, Any]:
    from bayessim_mjx.contract import words

    return {
        "verdict": words.outcome(result),
        "findings": [asdict(f) | {"sentence": f"{words.where(f)}: {words.sentence(f)}"} for f in result.findings],
        "compared": result.compared,
        "cannot_be_told": {name: words.WHY[reason] for name, reason in result.untold.items()},
        "notes": [words.note(text) for text in result.notes],
    }


main = cli.command(_policy)

if __name__ == "__main__":
    sys.exit(main())
