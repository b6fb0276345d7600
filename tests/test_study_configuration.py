"""The study file: its cases, its defaults, its draws and its complaints."""

import json
from pathlib import Path

import numpy as np
import pytest

from jaxsid.checks import InputError
from jaxsid.examples.systems import three_dof
from jaxsid.files.model_toml import write_model
from jaxsid.study.configuration import Study, read_study
from jaxsid.study.factors import FACTORS

HEAD = 'name = "test"\nseed = 3\nrealizations = 50\nchunk = 32\n'


def study(folder: Path, factors: str, head: str = HEAD) -> Study:
    path = folder / "study.toml"
    path.write_text(head + "[factors]\n" + factors)
    return read_study(path)


def test_a_grid(tmp_path):
    found = study(tmp_path, 'system = ["chain2", "rig"]\nnoise = [0, 0.01, 1]\nrealization = "era"\n')
    assert (found.name, found.seed, found.realizations, found.chunk) == ("test", 3, 50, 32)
    assert [c.index for c in found.cases] == list(range(6))
    assert [(c.values["system"], c.values["noise"]) for c in found.cases] == [
        (s, n) for s in ("chain2", "rig") for n in (0.0, 0.01, 1.0)
    ]
    assert found.varied == ("system", "noise")
    for case in found.cases:
        assert list(case.values) == list(FACTORS)
        assert all(type(v) is FACTORS[n].kind for n, v in case.values.items())


def test_defaults_are_spelled_out(tmp_path):
    (case,) = study(tmp_path, 'system = "chain3"\n').cases
    expected = {"data": "impulse", "noise": 0.01, "colour": "white", "realization": "era", "order": 6}
    expected |= {"rate": 4.0, "samples": 120, "rows": 59, "cols": 60, "stride": 1, "sensors": "default"}
    assert expected.items() <= case.values.items()
    (case,) = study(
        tmp_path, 'system = "rig"\ndata = "record"\nrealization = "era_dc"\nsamples = 100\n'
    ).cases
    expected = {"record_samples": 800, "method": "inband", "excitation": "multisine", "excitation_seed": 3}
    expected |= {"order": 3, "rows": 2, "first_lag": 2, "lags": 16, "lag_step": 1}
    assert expected.items() <= case.values.items()
    reach = 2 + case.values["rows"] + case.values["cols"] - 2 + 2 + 2 * 15
    assert reach == 99  # every sample is used


@pytest.mark.parametrize(("order", "expected"), [('"true"', 4), ('"true+3"', 7), ("5", 5)])
def test_orders(tmp_path, order, expected):
    (case,) = study(tmp_path, f'system = "chain2"\norder = {order}\n').cases
    assert case.values["order"] == expected


def test_what_has_no_meaning_makes_no_cases(tmp_path):
    factors = 'system = "chain2"\nrealization = ["era", "era_dc"]\nlags = [5, 9]\n'
    found = study(tmp_path, factors)
    assert [(c.values["realization"], c.values["lags"]) for c in found.cases] == [
        ("era", 0),
        ("era_dc", 5),
        ("era_dc", 9),
    ]
    found = study(
        tmp_path, 'system = "chain2"\ndata = ["impulse", "record"]\nmethod = ["fourier", "direct"]\n'
    )
    assert [c.values["method"] for c in found.cases] == ["", "fourier", "direct"]


def test_a_random_study_depends_on_its_seed_only(tmp_path):
    factors = 'system = ["chain2", "chain3"]\nnoise = {low = 1e-3, high = 0.1, scale = "log"}\n'
    factors += "samples = {low = 50, high = 90}\n"
    head = HEAD + 'sampling = "random"\ncases = 300\n'
    one, two = study(tmp_path, factors, head), study(tmp_path, factors, head.replace("50", "70"))
    assert one.cases == two.cases
    assert one.source == two.source
    assert study(tmp_path, factors, head.replace("seed = 3", "seed = 4")).cases != one.cases
    assert len(one.cases) == 300
    noise = np.log10([c.values["noise"] for c in one.cases])
    assert -3 <= noise.min() < -2.9 < -1.1 < noise.max() <= -1
    np.testing.assert_allclose(noise.mean(), -2, atol=0.1)  # three standard deviations
    samples = [c.values["samples"] for c in one.cases]
    assert {min(samples), max(samples)} <= {50, 51, 89, 90}
    assert {c.values["system"] for c in one.cases} == {"chain2", "chain3"}
    assert one.varied == ("system", "samples", "noise")


def test_the_source_knows_what_decides_results(tmp_path):
    factors = 'system = "chain2"\n'
    one = study(tmp_path, factors)
    assert study(
        tmp_path, factors, HEAD.replace("test", "other").replace("50", "60").replace("32", "64")
    ).source == (one.source)
    assert study(tmp_path, factors, HEAD.replace("seed = 3", "seed = 4")).source != one.source
    assert study(tmp_path, factors + "noise = 0.02\n").source != one.source
    assert study(tmp_path, factors + "noise = 0.01\n").source == one.source
    assert json.loads(one.source)["cases"] == [one.cases[0].values]


def test_a_model_file(tmp_path):
    write_model(three_dof(), tmp_path / "own.toml")
    factors = 'system = "own.toml"\nsensors = ["velocity", "sensor3, sensor1"]\ninputs = "force2"\n'
    first, second = study(tmp_path, factors).cases
    assert first.model is not None
    assert (first.values["rate"], first.values["samples"]) == (
        3.8,
        69,
    )  # 5 x 0.75 Hz, 4 periods of 1.38 rad/s
    assert second.values["sensors"] == "sensor3, sensor1"
    before = study(tmp_path, factors).source
    text = (tmp_path / "own.toml").read_text().replace("stiffness = 20.0", "stiffness = 21.0")
    (tmp_path / "own.toml").write_text(text)
    assert study(tmp_path, factors).source != before


@pytest.mark.parametrize(
    ("factors", "message"),
    [
        ("noise = 0.1\n", "'system' is missing"),
        ('system = "rik"\n', "Did you mean 'rig'"),
        ('system = "rig"\nnois = 0.1\n', "Did you mean 'noise'"),
        ('system = "rig"\nnoise = -0.1\n', "a number from 0 on"),
        ('system = "rig"\nnoise = inf\n', "'noise': must be a number"),
        ('system = "rig"\nnoise = true\n', "'noise': must be a number"),
        ('system = "rig"\nrate = 0\n', "above 0"),
        ('system = "rig"\nrows = 2.5\n', "a whole number from 1"),
        ('system = "rig"\norder = "most"\n', 'or "true"'),
        ('system = "rig"\ncolour = "whit"\n', "Did you mean 'white'"),
        ('system = "rig"\ncolour = []\n', "the list is empty"),
        ('system = "rig"\nnoise = [0.1, 0.1]\n', "the same value twice"),
        ('system = "rig"\nnoise = {low = 0.1, high = 1}\n', 'needs sampling = "random"'),
        ('system = "rig"\nsensors = "resolver, gyr"\n', "Did you mean 'gyro'"),
        ('system = "rig"\nsensors = "gyro, gyro"\n', "one of them twice"),
        ('system = "rig"\ninputs = "force"\n', "input 'force' is unknown"),
        ('system = "rig"\nrows = 150\ncols = 150\n', "up to sample 300, but its last one is 199"),
        ('system = "rig"\nrows = 1\ncols = 1\n', "order 3 needs a matrix"),
        (
            'system = "rig"\ndata = "record"\nmethod = "fourier"\nrecord_samples = 400\n',
            "segments of a quarter",
        ),
        ('system = "rig"\ndata = "record"\nrecord_samples = 100\n', "cannot come from a record of 100"),
        ('system = "lost.toml"\n', "there is no such file"),
    ],
)
def test_complaints(tmp_path, factors, message):
    with pytest.raises(InputError, match=message) as caught:
        study(tmp_path, factors)
    assert str(tmp_path / "study.toml") in str(caught.value)


@pytest.mark.parametrize(
    ("head", "factors", "message"),
    [
        (HEAD.replace("32", "40"), "", "multiple of 16, but found 40. Take 32"),
        (HEAD.replace("50", "0"), "", "'realizations'"),
        (HEAD + "cases = 4\n", "", "'cases'"),
        (HEAD + 'sampling = "random"\n', "", "'cases'"),
        (HEAD + "sed = 4\n", "", "Did you mean 'seed'"),
        (
            HEAD + 'sampling = "random"\ncases = 4\n',
            "noise = {low = 1, high = 0.1}\n",
            "low must be below high",
        ),
        (
            HEAD + 'sampling = "random"\ncases = 4\n',
            'noise = {low = 0, high = 1, scale = "log"}\n',
            "starts above 0",
        ),
        (HEAD + 'sampling = "random"\ncases = 4\n', "noise = {low = 0, top = 1}\n", "the keys 'low', 'high'"),
        (HEAD + 'sampling = "random"\ncases = 4\n', "colour = {low = 0, high = 1}\n", "takes words"),
    ],
)
def test_complaints_about_the_whole(tmp_path, head, factors, message):
    with pytest.raises(InputError, match=message):
        study(tmp_path, 'system = "chain2"\n' + factors, head)


def test_a_grid_too_large_is_refused(tmp_path):
    many = ", ".join(str(i) for i in range(20, 120))
    factors = f'system = "chain2"\nrows = [{many}]\ncols = [{many}]\nlags = [{many}]\n'
    with pytest.raises(InputError, match="1000000 cases"):
        study(tmp_path, factors)
