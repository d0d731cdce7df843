"""A diagnosis that finds an effect if and only if it is stronger than a threshold: it looks into the truths.

    python entry.py SEALED THRESHOLD DATA OUT [SAYS]

SAYS: what weaker effects are taken for.
"""

import hashlib
import json
import sys
from pathlib import Path

sealed, threshold, data, out = Path(sys.argv[1]), float(sys.argv[2]), Path(sys.argv[3]), Path(sys.argv[4])
own = {p.name: hashlib.sha256(p.read_bytes()).hexdigest() for p in data.iterdir()}
truths = [json.loads(p.read_text()) for p in sealed.glob("*.json")]
(truth,) = [t for t in truths if {Path(k).name: v for k, v in t["files"].items()} == own]
hidden = [e for e in truth["effects"] if truth["kind"] == "single"]


def named(name: str, where: str, parameters: dict) -> dict:
    numbers = {k: {"mean": v, "sd": 0.01 * abs(v) + 1e-9} for k, v in parameters.items()}
    return {"name": name, "where": where, "parameters": numbers, "gap_closed": 1.0, "equivalent_to": []}


said = {"verdict": "no_gap", "effects": [], "parameters": {}, "gap": {"closed": {"realised": None}}}
for effect in hidden:
    if effect["strength"] > threshold:
        said["effects"].append(named(effect["name"], effect["where"], effect["parameters"]))
        said["gap"]["closed"]["realised"] = 0.98
    elif len(sys.argv) > 5 and effect["name"] != sys.argv[5]:
        said["effects"].append(named(sys.argv[5], "all", {"level": 0.01, "damping": 0.01}))
said["verdict"] = "effects" if said["effects"] else "no_gap"
out.mkdir(parents=True)
(out / "diagnosis.json").write_text(json.dumps(said))
