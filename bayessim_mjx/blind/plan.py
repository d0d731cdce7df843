"""Which effect is hidden where, and how strong: rounds of cases, near where an effect begins to be found.

A round's strengths follow from the outcomes of the cases some rounds before it, whatever ran at the same time; so a
check is a function of its seed, a longer one begins with the cases of a shorter one, and cores need not wait for the
slowest case of a round.
"""

from collections.abc import Sequence

import numpy as np

from bayessim_mjx.blind.cases import Item
from bayessim_mjx.blind.curves import Curves, Group, Trial

# Which cases are made is a choice (docs/blind.md); it makes intervals wider or narrower, not wrong.
KINDS = "SSSNSSSSUN"  # single, null, unknown cause; over and over
FIRST, ROUND = 16, 8  # cases of the first round and of the others
BEHIND = 4  # rounds after which a round's outcomes count: the strengths of the first ones are spread widely
AT_ONCE = FIRST + (BEHIND - 1) * ROUND  # cases that need not wait for any other
SPREAD = (2.0, 40.0)  # encoder noises, of the first rounds
SHARES = (0.5, 0.9)  # how often later strengths are expected to be found
RANGE = (0.5, 500.0)  # encoder noises, of all rounds


def rounds(cases: int) -> list[range]:
    """Split the indices of the cases into rounds."""
    starts = [0, *range(FIRST, cases, ROUND)]
    return [range(a, min(b, cases)) for a, b in zip(starts, [*starts[1:], cases], strict=True)]


def known(own: range) -> int:
    """How many cases have to be finished before those of a round are planned: the first ones of all."""
    turns = rounds(own.start)
    return turns[-BEHIND].stop if len(turns) >= BEHIND else 0


def plan(
    own: range, groups: Sequence[Group], unknown: Sequence[Group], trials: Sequence[Trial], seed: int
) -> list[Item]:
    """Make the items of a round.

    Args:
        own: indices of its cases; groups, unknown: (effect, place) of what may be hidden, and of what no library has.
        trials: outcomes of the `known` cases; seed: of the check.
    """
    curves = Curves(trials) if trials else None
    out = []
    for index in own:
        kind = KINDS[index % len(KINDS)]
        if kind == "N" or (kind == "U" and not unknown):
            out.append(Item(index, "null"))
            continue
        turn = sum(KINDS[i % len(KINDS)] == kind for i in range(index))
        effect, where = in_turn(groups if kind == "S" else unknown, turn, seed)
        strength = _strength(curves, effect, where, turn, np.random.default_rng((seed, index, 1)))
        out.append(Item(index, "single" if kind == "S" else "unknown", effect, where, strength))
    return out


def in_turn(groups: Sequence[Group], turn: int, seed: int) -> Group:
    """Effects take turns, and so do the places of each."""
    rng = np.random.default_rng((seed, 2))
    effects = [str(e) for e in rng.permutation(sorted({e for e, _ in groups}))]
    effect = effects[turn % len(effects)]
    places = [str(w) for w in rng.permutation(sorted(w for e, w in groups if e == effect))]
    return effect, places[turn // len(effects) % len(places)]


def _strength(curves: Curves | None, effect: str, where: str, turn: int, rng: np.random.Generator) -> float:
    low, high = SPREAD
    if curves is None:
        share = (0.5 + turn * 0.6180339887) % 1.0  # evenly spread, however many there are
        return float(low * (high / low) ** share)
    drawn = curves.of(effect, where).draw(rng, rng.uniform(*SHARES))
    return float(np.clip(drawn, *RANGE))
