"""The known parameters refitted by mujoco.sysid; it names nothing.

pip install "mujoco[sysid]"
python benchmarks/blind/entries/refit.py MODEL LOGS OUT
"""

import json
import sys
from pathlib import Path


def refitted(model: Path, logs: Path) -> dict[str, float]:
    """Factors of mass, damping and armature, as mujoco.sysid finds them in windows of half a second."""
    sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "diagnosis"))
    import native
    import sysid as ours
    from mujoco import sysid

    if not hasattr(sysid, "optimize"):
        sys.exit('mujoco.sysid lacks its dependencies: pip install "mujoco[sysid]"')
    nominal = native.specification(str(model)).compile()
    cut, period = ours.pieces(logs.parent, nominal, None, ours.WINDOW)
    params = native.base(nominal)
    _, found = ours.optimise(ours.sequences(native.specification(str(model)), cut, period), params)
    return dict(zip(params.keys(), found.as_vector().tolist(), strict=True))


if __name__ == "__main__":
    if "--help" in sys.argv:
        sys.exit(print(f"usage: refit.py MODEL LOGS OUT\n{__doc__}"))
    factors = refitted(Path(sys.argv[1]).resolve(), Path(sys.argv[2]).resolve())
    told = {f"{name.replace('.', '_')}_mult": {"mean": x, "nominal": 1.0} for name, x in factors.items()}
    Path(sys.argv[3]).mkdir(parents=True, exist_ok=True)
    text = json.dumps({"verdict": "parameters", "effects": [], "parameters": told})
    (Path(sys.argv[3]) / "diagnosis.json").write_text(text)
