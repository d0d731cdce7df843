"""Results of every kind, made up: `python -m tests.diagnosis.phrases.cases` prints their sentences.

Each exists for sentences that no other has. Numbers are chosen so that shares can be checked by hand.
"""

import dataclasses

import mujoco
import numpy as np

from bayessim_mjx.diagnosis.fitting.delivered import Delivered
from bayessim_mjx.diagnosis.fitting.discretisation import Discretisation
from bayessim_mjx.diagnosis.phrases import advice, notes, parameters, time_step, verdict
from bayessim_mjx.diagnosis.request import Tolerance
from bayessim_mjx.diagnosis.result import Diagnosis, Estimate, FoundEffect, Gap
from bayessim_mjx.diagnosis.summary.estimates import answers

ROW = {
    "nominal": 0.0214, "calibrated": 0.0107, "with_effects": 0.000866, "unit": "rad", "tolerance": 0.02,
    "largest": 0.004, "motion": 1.0, "noise": 0.001, "beyond": False,
}  # fmt: skip
SHARES = {"nominal": 0.0214, "calibrated": 0.0107, "with_effects": 0.000866}
CLOSED = {"predicted": 0.66, "realised": 0.98, "elsewhere": 0.97, "nested": True, "ci": (0.9, 1.0)}
ALONE = CLOSED | {"elsewhere": None, "nested": False}
LEVEL = Gap(1.0, 21.4, 10.7, 0.866, 0.866, physical={"hinge": ROW}, shares=SHARES, closed=CLOSED)
NO_EFFECTS = dataclasses.replace(LEVEL, with_effects=LEVEL.calibrated, closed={})
RANKED = [
    {"effects": [*labels], "score": score, "se": 151.0}
    for labels, score in ((("gain@torque",), 2162.0), (("coulomb_friction@hinge",), 2085.0), ((), 0.0))
]
FURTHER = [RANKED[0] | {"effects": ["coulomb_friction@hinge", "gain@torque"], "gap_closed": 0.9815},
           RANKED[1] | {"gap_closed": 0.98}, RANKED[2]]  # fmt: skip
LARGER = [{"effects": ["coulomb_friction@hinge", "payload@arm"], "probability": 0.88, "nats": 900.0},
          {"effects": ["coulomb_friction@hinge"], "probability": 0.02, "nats": 880.0}]  # fmt: skip
FAST = '<mujoco><option integrator="implicitfast"/></mujoco>'
STEP = {"timestep": 0.005, "substep": 0.005, "integrator": "RK4", "delivered": "implicitfast"}
COARSE = dataclasses.replace(NO_EFFECTS, nominal=6.1, calibrated=0.93, with_effects=0.93)
BASIS = {"window": 0.5, "remains": 0.0, "above_noise": True}


def effect(name, where, closed=0.5, rivals=(), shared=None, **numbers):
    """numbers: {parameter: (mean, sd, unit[, bound])}."""
    found = {k: Estimate(*v) for k, v in numbers.items()}
    others = [{"effects": r, "gap_closed": 0.9, "why": "", "weight": 0.2} for r in rivals]
    own = 1.0 - 0.2 * len(others) if others else float("nan")
    return FoundEffect(
        name, where, found, own, closed, (closed - 0.1, closed), others, "", closed, closed, shared or {}
    )


FRICTION = effect("coulomb_friction", "hinge", 0.66, level=(0.1497, 0.0087, "N m"))
GAIN = effect("actuator_gain", "torque", 0.32, gain=(0.698, 0.036, ""))
SHARP = effect("coulomb_friction", "hinge", 0.66, level=(0.12, 0.0013, "N m", "", 0.0012))
UNSURE = effect("actuator_gain", "torque", 0.32, gain=(1.05, 0.55, ""))
DELAY = effect(
    "actuator_delay", "torque", 0.98, [["actuator_lag@torque"], ["sensor_delay@hinge"]],
    {"effects": ["actuator_delay@torque", "actuator_lag@torque"], "mean": 0.012, "low": 0.01, "high": 0.014,
     "unit": "s", "quantities": ["delay", "time_constant"]},
    delay=(0.012, 0.001, "s"),
)  # fmt: skip
PAYLOAD = effect("payload", "tool", 0.9, [["inertial_parameters@tool"]], mass=(0.99, 0.01, "kg"), com_x=(0.0, 0.1, "m"))
END = effect("backlash", "hinge", gap=(0.05, 0.0, "rad", "at least"))
FORCE = {
    "on": "effects", "joints": ["hinge"], "inputs": ["hinge speed", "hinge effort"],
    "held": {"condition": {"significant": True, "closed": 0.75, "at_noise": False},
             "interpolation": {"significant": True, "closed": 0.8, "at_noise": False}},
}  # fmt: skip
NOTHING = {**FORCE, "on": "recalibrated", "held": {k: {**v, "significant": False} for k, v in FORCE["held"].items()}}


def made(name, effects=(), far=None, experiment=None, **more):
    """A result with its sentences; more: fields, and those of `basis`."""
    fields = {f.name for f in dataclasses.fields(Diagnosis)}
    basis = BASIS | {k: v for k, v in more.items() if k not in fields}
    rest = {k: v for k, v in more.items() if k in fields}
    far = far or (LEVEL if effects else NO_EFFECTS)
    given = dict(where=[], parameters={}, candidates=[], warnings=[], versions={}) | rest
    found = Diagnosis(
        verdict=name, sentences=[], effects=list(effects), gap=far, next_experiment=experiment or {}, basis=basis,
        answers=answers(list(effects), experiment or {}), **given,
    )  # fmt: skip
    return dataclasses.replace(found, sentences=verdict.sentences(found))


def gap(far=LEVEL, rows=None, **changes):
    """A gap with some of its numbers changed; rows: of the joints."""
    physical = {"hinge": ROW} if rows is None else rows
    beyond = [n for n, r in physical.items() if r["beyond"]]
    return dataclasses.replace(far, physical=physical, beyond=beyond, **changes)


def coarse():
    """Results on a model whose time step makes much of the gap."""
    return {
        "no gap but the time step": made(
            "no_gap", far=gap(COARSE, integrator=STEP | {"otherwise": 1.02, "share": 0.99}), above_noise=False
        ),
        "no gap but the time step, and parameters that are hardly off": made(
            "no_gap", far=gap(COARSE, integrator=STEP | {"otherwise": 1.53, "share": 0.96}), above_noise=False
        ),
        "parameters and the time step": made(
            "parameters", far=gap(COARSE, integrator=STEP | {"otherwise": 4.0, "share": 0.59}), above_noise=False
        ),
    }


def every():
    """{what it shows: result}."""
    left = {"hinge": ROW | {"with_effects": 0.03, "largest": 0.09, "beyond": True}, "elbow": ROW}
    some = gap(rows=left, with_effects=3.0)
    quiet = {"nominal": 1.1, "calibrated": 1.0, "with_effects": 1.0}
    loud = {"nominal": 1.4, "calibrated": 1.3, "with_effects": 1.3}
    run = {"name": "chirp on hinge", "why": "run a chirp on hinge for 10 s", "file": "next_experiment.csv"}
    stuck = {"mean": 0.8, "structural": parameters.stuck(0.8), "at_bound": True, "data_sheet": ""}
    far = {"mean": 1.2, "structural": "", "at_bound": False, "away": 4.0}
    far |= {"data_sheet": parameters.far_from_data_sheet(1.2, 4.0)}
    moves = {"mean": 1.0, "structural": parameters.moves(0.2, 3), "at_bound": False, "data_sheet": ""}
    same = {"mean": 1.0, "structural": "", "data_sheet": "", "same_as": ["viscous_friction@hinge"]}
    known = {"hip": stuck, "knee": stuck, "arm": far, "leg": far, "foot": moves, "toe": same}
    plain = {"structural": "", "data_sheet": "", "nominal": 1.0}
    heavier = {"arm_mass_mult": plain | {"mean": 1.43, "sd": 0.022}, "leg_mass_mult": plain | {"mean": 1.1, "sd": 0.01}}
    few = {"hip": stuck, "arm": far}
    light = {"mean": 1.33, "sd": 0.33, "nominal": 1.0, "structural": "", "data_sheet": ""}
    light |= {"same_as": ["actuator_gain@motor"]}
    short = {"minutes": 5.0, "before": 2.0, "parts": ["3 pairs"]}
    chance = {"answer": 0.9, "rivals": 0.08, "nothing": 1e-9}
    return {
        "no gap": made("no_gap", far=gap(NO_EFFECTS, **quiet), above_noise=False),
        "a gap too small to identify": made("no_gap", far=gap(NO_EFFECTS, **loud), above_noise=False),
        **coarse(),
        "parameters": made("parameters", far=gap(NO_EFFECTS, calibrated=1.1, with_effects=1.1), above_noise=False),
        "parameters, or an effect": made(
            "parameters", far=gap(NO_EFFECTS, calibrated=1.1, with_effects=1.1), above_noise=False,
            parameters={"mass": light, "damping": light}, probability={"answer": 0.3, "rivals": 0.7, "nothing": 0.3},
        ),
        "parameters and a little": made("parameters", far=gap(NO_EFFECTS, calibrated=1.3, with_effects=1.3)),
        "noise, white": made("noise", noise_memory=0.0),
        "noise with a memory": made("noise", noise_memory=0.06),
        "one effect": made("effects", [FRICTION], probability=chance),
        "with another effect more probable": made("effects", [FRICTION], probability=chance, evidence=LARGER),
        "another set with the best score": made("effects", [FRICTION], probability=chance, candidates=RANKED),
        "a larger set with the best score": made("effects", [FRICTION], probability=chance, candidates=FURTHER),
        "two effects": made("effects", [FRICTION, GAIN], hidden=["viscous_friction@hinge"]),
        "one law at two joints": made("effects", [FRICTION, dataclasses.replace(FRICTION, where="elbow")]),
        "one log": made("effects", [FRICTION], gap(closed=ALONE, in_sample=True)),
        "a remainder": made("effects", [FRICTION], some),
        "much is left within the tolerance": made("ambiguous", [FRICTION, PAYLOAD], gap(with_effects=6.0)),
        "an effect at its bound": made("effects", [dataclasses.replace(END, sentence="Gap ends.")]),
        "a class with a number": made("ambiguous", [DELAY], experiment=run, probability=chance),
        "a class without a number": made("ambiguous", [FRICTION, PAYLOAD]),
        "a class that no motion separates": made("ambiguous", [FRICTION, PAYLOAD], experiment={"name": "none"}),
        "unexplained": made("unexplained", flexible=FORCE | {"on": "recalibrated"}, tried=["coulomb_friction"]),
        "unexplained by chance": made("unexplained", flexible=NOTHING, not_tried=short),
        "partly": made("unexplained", [FRICTION], some, remains=0.2, flexible=FORCE),
        "a model far from the robot": made("unexplained", [UNSURE], some, remains=16.5),
        "nearest": made("unexplained", [GAIN], gap(with_effects=6.0), far_off=(3, 6)),
        "little is closed": made(
            "unexplained", [GAIN], gap(with_effects=8.0), probability=chance, remains=0.4, flexible=NOTHING
        ),
        "little is closed, far beyond": made("unexplained", [GAIN], dataclasses.replace(some, with_effects=8.0)),
        "beside joints that keep their speed": made("unexplained", [GAIN], gap(with_effects=6.0, coasting=5.0)),
        "known parameters": made("effects", [FRICTION], parameters=known, builds_up=3.0),
        "a heavier link": made("effects", [FRICTION], parameters=heavier, accuracy={"mass": {"low": 0.15}}),
        "known better than simulators agree": made("effects", [SHARP]),
        "one parameter": made("effects", [FRICTION], parameters=few, efforts="the motors follow"),
    }  # fmt: skip


def steps():
    """Notes on the delivered time step: with another integrator, of logs with noise, and of those without."""
    one, other = np.full(2, 1e-3), Delivered(mujoco.MjModel.from_xml_string(FAST), 0.02)
    given = dict(timestep=0.005, order=1.0, own=7 * one, settled=6 * one, sigma=one, channels=("hinge",))
    left, noisy, quiet = np.array([2e-4, 0.0]), np.zeros(1, bool), np.ones(1, bool)
    made = [
        dict(factor=1, left=left, floor=one, simulated=noisy, integrator="RK4", delivered=other),
        dict(factor=2, left=one, floor=2 * one, simulated=noisy),
        dict(factor=1, left=one, floor=7 * one, simulated=quiet),
    ]
    return [text for more in made for text in time_step.costs(Discretisation(**given, **more))]


def warnings():
    """Notes that stand among the warnings."""
    one = np.ones(1)
    allowed = Tolerance(("hinge",), ("rad",), 1e-3 * one, one, 0.01 * one, one > 0)
    names = [f"log {i}" for i in range(8)]
    away = {"nominal": 2, "calibrated": 0}
    levels = [("0.1 s", 3.0, 1.1), ("whole log", 9.0, 12.0)]
    rows = [{"name": n, "calibrated": c, "with_effects": w, "ci": {"with_effects": [w, w]}} for n, c, w in levels]
    return [
        *notes.out_of_time(notes.out_of_time((), "whole logs"), "next experiment"),
        notes.failed("where", ValueError("no windows")),
        *notes.below_noise(allowed),
        *notes.rows(0.0001, 0.002, 0.0005, fastest=True),
        *notes.rows(0.001, 0.002, 0.001, fastest=False),
        *notes.conditions(1, one_log=True),
        *notes.conditions(3, one_log=False),
        *notes.finer_steps([("hinge.delay", 0.012, 0.002, "s", 0.0002), ("mass", 1.0, 0.1, "kg", 0.1)]),
        *notes.whole_logs(names, names[:6], names[6:7], 2.4, away, 7, 3),
        *notes.whole_logs(names, names, [], 0.0, {}, 0, 0),
        *notes.horizon_warning(Gap(1.0, 4.0, 3.0, 1.1, 1.0, horizons=rows)),
        *steps(),
        time_step.written("RK4", 0.005, "implicitfast", 0.005),
        parameters.less_accurate({"mass": (0.2, 0.1, 0.4)}),
    ]


def text():
    """All sentences with advice, in one text."""
    parts = []
    for name, d in every().items():
        said = advice.verdict_of(d)
        parts.append("\n".join([f"# {name}", f"[{said.badge}] {said.advice}", *d.sentences]))
    parts.append("\n".join(["# warnings", *warnings()]))
    return "\n\n".join(parts) + "\n"


if __name__ == "__main__":
    print(text(), end="")
