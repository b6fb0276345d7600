"""How far numbers found lie from true ones: with whom an error of the model's numbers is compared, and what counts."""

import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks/blind"))

from deviations import pulls, within  # pyright: ignore[reportMissingImports]


def system(mass, stiffness):
    return {
        "name": "chain",
        "bodies": ["a", "b"],
        "mass": mass,
        "connections": [["k1", ["ground", "a"], stiffness, 1.0], ["k2", ["a", "b"], 50.0, 1.0]],
        "inputs": [["force", "a"]],
        "sensors": [["acc", "b", "acceleration"]],
        "dt": 0.01,
    }


def label(kind, place, **parameters):
    effect = {"kind": kind, "place": place, "parameters": [parameters, parameters]}
    return {
        "nominal": system([1.0, 2.0], 100.0),
        "true": system([1.0, 2.2], 90.0),
        "effects": [effect],
    }


def found(kind, place, **parameters):
    told = {n: {"value": v, "std": s} for n, (v, s) in parameters.items()}
    return {"selected": [{"kind": kind, "place": place, "parameters": told}]}


BODY, GROUND = {"body": "b"}, {"between": ["a", "ground"]}


@pytest.mark.parametrize(
    ("kind", "place", "ratio"), [("mass_error", BODY, 1.1), ("stiffness_error", GROUND, 0.9)]
)
def test_wrong_numbers_are_told_next_to_the_nominal_ones(kind, place, ratio):
    """The truth is off within its tolerance besides: 1.5 times the true number is 1.5 ratio times the nominal one."""
    told = found(kind, place, factor=(1.5 * ratio + 0.02, 0.01))
    assert pulls(label(kind, place, factor=1.5), told) == pytest.approx([2.0])


def test_only_what_was_found_with_its_kind_at_its_place_counts_and_no_angle():
    true = label("periodic_disturbance", BODY, amplitude=2.0, phase=0.1)
    told = found("periodic_disturbance", BODY, amplitude=(1.7, 0.1), phase=(9.0, 0.1))
    assert pulls(true, told) == pytest.approx([-3.0])
    assert pulls(true, found("constant_load", BODY, force=(1.7, 0.1))) == []
    assert pulls(true, found("periodic_disturbance", {"body": "a"}, amplitude=(1.7, 0.1))) == []
    assert pulls(true, found("periodic_disturbance", BODY, amplitude=(1.7, 0.0))) == []
    assert pulls(true, {}) == []


def test_shares_within_one_two_and_three_deviations():
    assert within([0.5, -1.5, 2.5, -3.5]) == {"numbers": 4, "shares": [0.25, 0.5, 0.75]}
    assert within([])["shares"] == [None] * 3
