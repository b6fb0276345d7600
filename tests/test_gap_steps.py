"""Steps of a simulation in fits: short enough for a law's kinks."""

import numpy as np
import pytest
from gap_bench import bench
from gap_helpers import JOINT, drive
from gap_helpers import with_effect as truth

from jaxsid.gap.refit import FINEST, UNRESOLVED, Hypothesis, changes_of, refitted, resolved
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


@pytest.mark.slow
def test_steps_are_shorter_where_a_number_lies_off_that_no_sample_shows():
    """Many samples together tell more than each: a number is a tenth of its deviation off, and that is foreseen."""
    y = truth(drive(), "bilinear_stiffness", JOINT, {"stiffness": 500.0})
    level = 0.01 * y.std(axis=0)
    of = bench(y + level * np.random.default_rng(0).standard_normal(y.shape), level)
    found = refitted(of, Hypothesis((effect("bilinear_stiffness", ("b1", "b2"), stiffness=500.0),)))
    for shift in (np.inf, 0.2):
        assert resolved(of, found, shift=shift) is of
    finer = resolved(of, found, shift=0.05)
    assert finer.substeps > of.substeps
    begin = {"changes": changes_of(found, of), "states": found.fit.states}
    far = refitted(of._replace(substeps=2 * FINEST), found.hypothesis, **begin)
    near = refitted(finer, found.hypothesis, **begin)
    value = lambda x: x.hypothesis.effects[0].parameters["stiffness"] / found.deviations[0]["stiffness"]  # noqa: E731
    assert 0.05 < abs(value(far) - value(found)) < 0.2
    assert abs(value(far) - value(near)) < 0.05
