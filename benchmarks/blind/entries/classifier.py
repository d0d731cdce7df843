"""A classifier trained on simulations: linear discriminants of the terms' t values, learnt from development cases.

python benchmarks/blind/entries/classifier.py --train SUITE      # its cases with one effect or none
python benchmarks/blind/entries/classifier.py MODEL LOGS OUT
"""

import json
import sys
from pathlib import Path

import numpy as np
from regression import Problem, least_squares, problems, write

LEARNT = Path(__file__).with_name("classifier.npz")
SHRINK, NOTHING = 0.3, "nothing"


def features(p: Problem) -> np.ndarray:
    """Compressed t values of all terms, fitted alone and together."""
    alone = [least_squares(p, [k]) for k in range(p.X.shape[1])]
    x, errors, _ = least_squares(p, list(range(p.X.shape[1])))
    t = np.array([*(float(c[0] / e[0]) for c, e, _ in alone), *(x / errors)])
    return np.sign(t) * np.log1p(np.abs(t))


def train(suite: Path) -> None:
    """Means by class and the shrunk common precision, from all driven joints of cases with at most one effect."""
    rows, labels = [], []
    for file in sorted((suite / "sealed").glob("*.json")):
        truth = json.loads(file.read_text())
        if truth["kind"] in ("unknown", "double"):
            continue
        given = suite / "cases" / file.stem / "given"
        effect = next(iter(truth["effects"]), None)
        for p in problems(str(given / "model.xml"), str(given / "logs")):
            own = effect and effect["where"] in (p.joint, p.actuator, p.body, "world")
            rows.append(features(p))
            labels.append(effect["name"] if own else NOTHING)
    x, names = np.array(rows), sorted(set(labels))
    index = np.array([names.index(name) for name in labels])
    means = np.stack([x[index == k].mean(0) for k in range(len(names))])
    within = x - means[index]
    covariance = within.T @ within / len(x)
    ridge = np.trace(covariance) / len(covariance)
    precision = np.linalg.inv((1 - SHRINK) * covariance + SHRINK * ridge * np.eye(len(covariance)))
    np.savez(LEARNT, means=means, precision=precision, names=np.array(names))
    print(f"{len(x)} joints of {len(set(names))} classes: {LEARNT}")


def classify(given: list[Problem]) -> list[tuple[str, str]]:
    """The clearest effect, at its joint; none where every joint looks like nothing."""
    learnt = np.load(LEARNT)
    names, best = [str(n) for n in learnt["names"]], []
    for p in given:
        along = learnt["means"] @ learnt["precision"]
        score = along @ features(p) - 0.5 * np.sum(along * learnt["means"], 1)
        k = int(np.argmax(score))
        best.append((float(score[k] - score[names.index(NOTHING)]), names[k], p.joint))
    lead, name, joint = max(best)
    return [(name, joint)] if lead > 0 and name != NOTHING else []


if __name__ == "__main__":
    if "--help" in sys.argv:
        sys.exit(print(f"usage: classifier.py --train SUITE | MODEL LOGS OUT\n{__doc__}"))
    if sys.argv[1] == "--train":
        train(Path(sys.argv[2]))
    elif not LEARNT.exists():
        sys.exit(f"{LEARNT}: not trained yet; see --help")
    else:
        found = classify(problems(sys.argv[1], sys.argv[2]))
        write("effects" if found else "parameters", found)
