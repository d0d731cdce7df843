"""Every candidate of a setup fitted alone, as a test's beginning."""

from bayessim_mjx.diagnosis.selection.successive_halving import begin, fit_entries


def fitted(setup, candidates=None):
    """The pool with the known parameters and all single effects, each from its screened start and its probes."""
    pool = begin(setup.fitter, setup.candidates if candidates is None else candidates, setup.settings)
    entries = {}
    for s in pool.screened:
        starts = [pool.fitter.derive(pool.base.fit, s.candidate.coordinates, x) for x in (s.start, *s.others)]
        entries[frozenset([s.candidate.label])] = (starts, (s.candidate,))
    fit_entries(pool, entries, "single effects", lambda text, done, total: None)
    return pool
