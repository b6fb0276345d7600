"""Steps of a simulation in fits: short enough for a law's kinks."""

import numpy as np
from gap_bench import bench
from gap_helpers import JOINT, drive
from gap_helpers import with_effect as truth

from jaxsid.gap.refit import FINEST, UNRESOLVED, Hypothesis, refitted, resolved
from jaxsid.gap.shooting import products_of
from jaxsid.mechanics.lumped import Effect


def effect(kind, place, **parameters):
    return Effect(kind, (("between", place),), parameters)


def left_in_noise(of, found):
    each = products_of(found.shot, of.blocks, found.fit.theta, found.fit.states, of.substeps)
    parts = zip(each, of.blocks, strict=True)
    return np.concatenate(
        [(np.asarray(x.left) * np.asarray(b.weight))[:, b.lead :].ravel() for x, b in parts]
    )


def test_steps_are_shorter_where_a_law_has_kinks():
    y = truth(drive(), "backlash", JOINT, {"half_gap": 1e-5})
    of = bench(y, 1e-4 * y.std(axis=0))
    smooth = refitted(of, Hypothesis((effect("cubic_stiffness", ("b1", "b2"), coefficient=1e3),)))
    assert resolved(of, smooth) is of
    play = refitted(of, Hypothesis((effect("backlash", ("b1", "b2"), half_gap=1e-5),)))
    finer = resolved(of, play)
    assert of.substeps < finer.substeps <= FINEST
    # against far shorter steps, what is left differs by less than before
    best = left_in_noise(of._replace(substeps=8 * FINEST), play)
    apart = [np.sqrt(((left_in_noise(x, play) - best) ** 2).mean()) for x in (of, finer)]
    assert apart[1] < apart[0] / 4
    assert apart[0] > UNRESOLVED
    diverged = refitted(of, Hypothesis((effect("cubic_stiffness", ("b1", "b2"), coefficient=-1e9),)))
    assert resolved(of, diverged) is of
