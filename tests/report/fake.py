"""Made-up diagnoses: a rich one of a three-joint arm with everything in it, and a bare one per verdict."""

import math

import numpy as np

from bayessim_mjx.diagnosis.result import Diagnosis, Estimate, FoundEffect, Gap, Place

JOINTS = ("shoulder", "elbow", "wrist")
HOSTILE = "<script>alert('log')</script> & \"co\".npz"
LABELS = (
    "coulomb_friction@elbow",
    "stribeck_friction@elbow",
    "viscous_friction@elbow",
    "load_friction@elbow",
    "actuator_delay@m_shoulder",
    "actuator_lag@m_shoulder",
    "payload@hand",
    "actuator_gain@m_wrist",
    "joint_offset@shoulder",
    "backlash@wrist",
)


def _motion(rng, joint, log):
    time = np.arange(0, 4, 0.02)
    starts = np.arange(0, 4, 0.5)
    phase = time - starts[np.searchsorted(starts, time, side="right") - 1]
    real = 0.8 * np.sin(1.7 * time + 0.6 * joint) + 0.25 * np.sin((4.1 + log) * time)
    drift = phase**2 * np.sign(np.cos(1.7 * (time - phase) + 0.6 * joint))
    stages = {"nominal": 0.9, "calibrated": 0.5, "with_effects": 0.04}
    simulated = {s: (real + a * drift + 0.002 * rng.normal(size=time.size)).tolist() for s, a in stages.items()}
    measured = np.round(real + 0.003 * rng.normal(size=time.size), 3)
    return {"time": time.tolist(), "measured": measured.tolist(), "starts": starts.tolist(), **simulated}


def _maps(rng, joint):
    axes = (
        ("position", "rad", -1.2, 1.2),
        ("speed", "rad/s", -3, 3),
        ("direction", "", -1, 1),
        ("load", "N m", -2, 2),
        ("time since reversal", "s", 0, 1.2),
        ("time", "s", 0, 4),
    )
    out = []
    for axis, unit, low, high in axes:
        n = 2 if axis == "direction" else 9
        edges = np.linspace(low, high, n + 1)
        centre = 0.5 * (edges[1:] + edges[:-1])
        size = 0.03 if joint == "elbow" else 0.004
        mean = (
            size * np.sign(centre) if axis in ("speed", "direction") else size * np.exp(-2 * np.abs(centre)) - size / 3
        )
        mean = mean + 0.002 * rng.normal(size=n)
        half = 0.004 + 0.003 * rng.random(n)
        out.append(
            {
                "joint": joint,
                "axis": axis,
                "unit": unit,
                "edges": edges.tolist(),
                "mean": mean.tolist(),
                "low": (mean - half).tolist(),
                "high": (mean + half).tolist(),
                "count": rng.integers(20, 400, n).tolist(),
                "force_unit": "N m",
                "significant": (np.abs(mean) > 2 * half).tolist(),
            }
        )
    return out


def _frequency(joint):
    hz = np.geomspace(0.3, 20, 40)
    gain = 1 / np.sqrt(1 + (hz / 4) ** 2)
    return {
        "joint": joint,
        "hz": hz.tolist(),
        "coherence_real": (0.97 - 0.01 * hz).tolist(),
        "coherence_sim": (0.995 - 0.001 * hz).tolist(),
        "phase_sim_deg": (-np.degrees(np.arctan(hz / 4))).tolist(),
        "phase_real_deg": (-np.degrees(np.arctan(hz / 4)) - 360 * 0.021 * hz).tolist(),
        "gain_real": (0.93 * gain).tolist(),
        "gain_sim": gain.tolist(),
        "orders": [{"order": k, "amplitude": 0.01 / k + 0.02 * (k == 7)} for k in range(1, 13)],
    }


def _isolability():
    n = len(LABELS)
    at = np.arange(n)
    cosine = np.exp(-np.abs(at[:, None] - at[None]) / 4) * np.where((at[:, None] // 4) == (at[None] // 4), 1, 0.3)
    np.fill_diagonal(cosine, 1)
    absorbed = [0.41, 0.38, 0.97, 0.22, 0.12, 0.14, 0.88, 0.95, 0.06, 0.3]
    return {"labels": list(LABELS), "cosine": cosine.tolist(), "absorbed": absorbed}


def _command(scale=1.0):
    time = np.arange(0, 10, 0.02)
    chirp = scale * np.sin(2 * np.pi * (0.2 + 0.15 * time) * time)
    return {"time": time.tolist(), "ctrl": {"m_shoulder": chirp.tolist(), "m_elbow": (0.6 * np.sign(chirp)).tolist()}}


def details(seed=0):
    rng = np.random.default_rng(seed)
    logs = ("chirp_01.npz", "steps_02.npz", HOSTILE)
    names = ["slow", "fast", "loaded"]
    overlays = [
        {"log": log, "joint": j, "unit": "rad", **_motion(rng, k, m)}
        for m, log in enumerate(logs)
        for k, j in enumerate(JOINTS)
    ]
    return {
        "overlays": overlays,
        "isolability": _isolability(),
        "maps": [m for j in JOINTS for m in _maps(rng, j)],
        "frequency": [_frequency(j) for j in JOINTS],
        "episodes": [
            {
                "log": log,
                "condition": names[k % 3],
                "nominal": 14 + 9 * k,
                "calibrated": 9 + 4 * k,
                "with_effects": 1.4 + 0.3 * k,
            }
            for k, log in enumerate([*logs, "drop_04.npz", "hold_05.npz", "prbs_06.npz"])
        ],
        "black_boxes": {
            "network": 0.87,
            "formula": -0.2,
            "named_effects": 0.93,
            "folds": 4,
            "terms": [{"joint": "hinge", "term": "sign w", "force": -0.06}],
            "formula_in_words": ["hinge: -0.06 sign w"],
        },
        "flexible": {
            "depends_on": [
                {"input": "speed", "importance": 0.51},
                {"input": "load", "importance": 0.22},
                {"input": "position", "importance": 0.05},
            ],
            "where": ["wrist, above 2 rad/s: 0.004 N m remain"],
            "seeds": [1.52, 1.55, 1.49, 1.61, 1.57],
            "rms_on_base": 2.9,
            "rms_on_winner": 1.53,
        },
        "groups": {
            "names": names,
            "parameters": {
                "shoulder.damping": {"mean": [0.11, 0.108, 0.112], "sd": [0.004, 0.003, 0.005]},
                "elbow.damping": {"mean": [0.31, 0.14, 0.22], "sd": [0.012, 0.01, 0.02]},
                "hand.mass": {"mean": [0.41, 0.42, 0.66], "sd": [0.01, 0.012, 0.02]},
            },
        },
        "links": [
            {
                "name": "command → effort",
                "slope": 0.99,
                "correlation": 0.9996,
                "lag": 0.021,
                "verdict": "follows the declared law, 21 ms late",
            },
            {
                "name": "effort → motion",
                "slope": 0.83,
                "correlation": 0.94,
                "lag": 0.0,
                "verdict": "most of the gap arises here",
            },
            {
                "name": "motion → measurement",
                "slope": 1.0,
                "correlation": 0.9999,
                "lag": 0.0,
                "verdict": "velocity agrees with position",
            },
        ],
        "experiments": [
            {
                "name": "slow triangle",
                "evidence": 12.4,
                "pairs": [{"a": LABELS[0], "b": LABELS[1], "evidence": 12.4}],
                "command": _command(),
            },
            {
                "name": "chirp",
                "evidence": 3.1,
                "pairs": [{"a": LABELS[0], "b": LABELS[1], "evidence": 3.1}],
                "command": _command(0.5),
            },
        ],
        "noise": [
            {
                "channel": j,
                "sigma": 0.0029 + 0.001 * k,
                "quantum": 0.001,
                "rest": 0.0028,
                "highfrequency": 0.003,
                "source": "rest segments",
            }
            for k, j in enumerate(JOINTS)
        ],
        "reproducibility": {"pairs": 2, "rms": 1.31},
    }


def full():
    """Everything there is: two effects, one with a rival; hostile strings; warnings; all details."""
    delay = FoundEffect(
        LABELS[4].split("@")[0],
        "m_shoulder",
        {"delay": Estimate(0.0213, 0.0011, "s")},
        float("nan"),
        0.27,
        (0.21, 0.33),
        sentence="Commands reach the shoulder motor about one control step late.",
        predicted_gap_closed=0.31,
        share=0.29,
    )
    rival = {
        "effects": ["stribeck_friction@elbow"],
        "gap_closed": 0.66,
        "weight": 0.09,
        "why": "no log moves the elbow slower than 0.2 rad/s",
    }
    friction = FoundEffect(
        "coulomb_friction",
        "elbow",
        {"level": Estimate(0.0312, 0.0021, "N m")},
        0.91,
        0.68,
        (0.61, 0.74),
        [rival],
        "Dry friction at the elbow, seen at every reversal.",
        0.66,
        0.71,
    )
    stages = ("nominal", "calibrated", "with_effects", "reducible_floor", "noise_floor")
    rows = {
        "0.1 s": (8.1, 5.2, 1.3, 1.2, 1.0),
        "0.25 s": (21.4, 13.1, 1.9, 1.5, 1.0),
        "whole log": (88.0, 61.0, 12.3, 7.2, 1.0),
    }
    horizons = [
        {
            "name": n,
            "seconds": s,
            **dict(zip(stages, v, strict=True)),
            "ci": {k: [0.9 * x, 1.12 * x] for k, x in zip(stages, v, strict=True)},
            "floor": "start" if n == "whole log" else "repeats",
            "shares": {k: x / 1200 for k, x in zip(stages, v, strict=True)},
        }
        for (n, v), s in zip(rows.items(), (0.1, 0.25, 4.0), strict=True)
    ]
    gap = Gap(
        1.0,
        21.4,
        13.1,
        1.9,
        1.5,
        by_channel={
            "shoulder": dict(zip(stages, (14.2, 9.9, 1.7, 1.4, 1.0), strict=True)),
            "elbow": dict(zip(stages, (32.1, 19.8, 2.2, 1.6, 1.0), strict=True)),
            "wrist": dict(zip(stages, (7.7, 4.1, 1.7, 1.5, 1.0), strict=True)),
        },
        horizons=horizons,
        physical={
            j: dict(zip(stages, (0.041, 0.029, 0.0051, 0.0043, 0.003), strict=True))
            | {"unit": "rad", "noise": 0.003, "motion": 1.9, "tolerance": 0.038, "largest": 0.021, "beyond": False}
            for j in JOINTS
        },
        shares={"nominal": 0.0178, "calibrated": 0.0109, "with_effects": 0.0016},
    )
    parameters = {
        f"{j}.{p}": {
            "mean": 1.07 * v,
            "sd": 0.02 * v,
            "nominal": v,
            "low": 0.8 * v,
            "high": 1.2 * v,
            "unit": u,
            "structural": "",
        }
        for j in JOINTS
        for p, v, u in (("damping", 0.1, "N m s/rad"), ("armature", 0.0042, "kg m^2"))
    }
    moves = "moves from 0.31 to 0.14 between conditions slow and fast: a sign of something missing"
    parameters["elbow.damping"] |= {"mean": 0.1195, "structural": moves}
    parameters["hand.mass"] = {
        "mean": 0.42,
        "sd": 0.01,
        "nominal": 0.4,
        "low": 0.32,
        "high": 0.48,
        "unit": "kg",
        "structural": "",
    }
    candidates = [
        {
            "effects": [LABELS[0], LABELS[4]],
            "label": "+",
            "score": 412.0,
            "se": 14.0,
            "gap_closed": 0.955,
            "parameters": {},
            "absorbed": 0.2,
        },
        *(
            {
                "effects": [x],
                "label": x,
                "score": 330.0 / (k + 1),
                "se": 12.0 + k,
                "gap_closed": 0.7 / (k + 1),
                "parameters": {"level": {"mean": 0.03, "sd": 0.002, "unit": "N m"}},
                "absorbed": 0.1 * k,
            }
            for k, x in enumerate(LABELS)
        ),
    ]
    return Diagnosis(
        "effects",
        [
            "The simulator lacks Coulomb friction at the elbow and a command delay at the shoulder; both close 96 %.",
            "Recalibrating the parameters alone closes 63 %, with a damping that changes between conditions.",
            "Coulomb and Stribeck friction at the elbow cannot be told apart by these logs.",
        ],
        [friction, delay],
        [
            Place("elbow", 0.62, (0.55, 0.69), "elbow, at reversals below 0.2 rad/s"),
            Place("shoulder", 0.29, (0.22, 0.36), "shoulder, at all speeds, growing with speed"),
            Place("wrist", 0.09, (0.04, 0.13), "wrist: nothing stands out"),
        ],
        gap,
        parameters,
        candidates,
        [
            f"{HOSTILE}: 3 % of the stamps jitter by more than a tenth of the period",
            "wrist: velocity is quantised to 0.02 rad/s",
            "One condition has a single log: its interval comes from blocks.",
        ],
        {
            "name": "slow triangle",
            "why": "separates Coulomb from Stribeck friction at the elbow",
            "evidence": 12.4,
            "file": "next_experiment.csv",
            "table": [{"experiment": "slow triangle", "evidence": 12.4}, {"experiment": "chirp", "evidence": 3.1}],
        },
        {
            "bayessim_mjx": "0.1.0",
            "jax": "0.10.2",
            "mujoco": "3.4.0",
            "seed": "0",
            "command": "python -m bayessim_mjx.diagnose --model arm.xml --data logs/ --seed 0",
        },
        details(),
        about={
            "robot": "arm",
            "data": ["logs/2026-11"],
            "logs": 6,
            "seconds": 48.0,
            "conditions": 3,
            "date": "2026-11-22 18:30",
        },
    )


def bare(verdict):
    """The least that a diagnosis may hold."""
    nan = math.nan
    gap = Gap(1.0, nan, nan, nan, nan) if verdict == "insufficient_data" else Gap(1.0, 3.0, 1.2, 1.1, 1.05)
    return Diagnosis(verdict, [], [], [], gap, {}, [], [], {}, {})
