"""What is held for likely before a fit: sizes of laws are not drawn to none, however large they are."""

import numpy as np
import pytest
from gap_bench import bench, colored
from gap_helpers import drive, exact

from jaxsid.gap.refit import FARTHEST, Hypothesis, prior_of, refitted, shot_of
from jaxsid.mechanics.lumped import Effect

# offsets of a sensor, next to its signal
LITTLE, SIZE, LARGE = 0.01, 10.0, 3000.0


def offset(size):
    return Hypothesis((Effect("sensor_bias", (("sensor", "s1"),), {"offset": size}),))


@pytest.fixture(scope="module")
def shown():
    """Readings without an offset, and the level of what is white in their noise."""
    return colored(exact(drive()), 5)


def test_what_a_search_begins_with_is_never_farther_off_than_four_deviations(shown):
    of = bench(*shown)

    def deviation(hypothesis):
        shot = shot_of(of, hypothesis.effects)
        z = shot.coordinates.unknowns(
            np.array([[x for x in e.parameters.values()] + [0.0] * 3 for e in hypothesis.effects])
        )
        return prior_of(of, hypothesis, shot).deviation[len(of.tolerance)], float(z[0, 0])

    level = shown[0][:, 1].std()
    (little, below), (large, beyond) = deviation(offset(LITTLE * level)), deviation(offset(-LARGE * level))
    assert abs(below) < FARTHEST < abs(beyond)
    assert little == 1.0
    assert large == pytest.approx(abs(beyond) / FARTHEST)


def test_a_large_law_is_not_drawn_to_none(shown):
    """With a prior of one width for all it would come out many of its own deviations too small."""
    y, level = shown[0].copy(), shown[1]
    true = SIZE * y[:, 1].std()
    y[:, 1] += true
    of = bench(y, level)
    # signals as small as they were before the law made them large
    of = of._replace(moved=tuple(m._replace(y=m.y / LARGE) for m in of.moved))
    found = refitted(of, offset(1.01 * true))
    (effect,), (deviations,) = found.hypothesis.effects, found.deviations
    deviation = deviations["offset"]
    assert abs(float(effect.parameters["offset"]) - true) < 3 * deviation
    # how far a prior of width one would draw it, in its own deviations: z^2 s / size
    z = found.fit.theta[len(of.tolerance)]
    assert z**2 * deviation / true > 10
