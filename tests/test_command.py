"""The command `jaxsid`: what it writes, and one clear message with the right exit code for what it cannot use."""

import json
import os
import subprocess
import sys

import numpy as np
import pytest
from band_limited import DT, THREE, chain, error, experiment
from typer.testing import CliRunner

from jaxsid.cli import app
from jaxsid.files.model_toml import read_model

SYSTEM = chain(*THREE)
MODEL = """name = "three masses"
[bodies]
b1 = 1.5
b2 = 0.7
b3 = 0.9
[[connections]]
name = "c1"
between = ["ground", "b1"]
stiffness = 2400.0
damping = 1.0
[[connections]]
name = "c2"
between = ["b1", "b2"]
stiffness = 3000.0
damping = 1.0
[[connections]]
name = "c3"
between = ["b2", "b3"]
stiffness = 1700.0
damping = 1.2
[[inputs]]
name = "force"
body = "b1"
[[sensors]]
name = "s1"
body = "b1"
kind = "acceleration"
[[sensors]]
name = "s2"
body = "b2"
kind = "acceleration"
[[sensors]]
name = "s3"
body = "b3"
kind = "acceleration"
"""
NAMES = ("time", "force", "s1", "s2", "s3")


def write_csv(path, columns):
    with path.open("w") as stream:
        stream.write(",".join(columns) + "\n")
        np.savetxt(stream, np.column_stack(list(columns.values())), delimiter=",", fmt="%.10g")
    return path


@pytest.fixture(scope="module")
def columns():
    u, y = experiment(SYSTEM, 0, seconds=10.0)
    return dict(zip(NAMES, np.column_stack([np.arange(len(u)) * DT, u, y]).T, strict=True))


@pytest.fixture
def files(tmp_path, columns):
    model = tmp_path / "model.toml"
    model.write_text(MODEL)
    return model, write_csv(tmp_path / "run.csv", columns), tmp_path / "out"


@pytest.fixture(autouse=True)
def own_cache(monkeypatch, request):
    """The command keeps compiled programs where the tests keep theirs."""
    monkeypatch.setenv("JAXSID_CACHE", str(request.config.rootpath / ".pytest_cache" / "jax"))


def call(*arguments):
    return CliRunner().invoke(app, [str(a) for a in arguments])


def refused(result, out, code, *texts):
    """One message on standard error that says all of `texts`, nothing written."""
    assert result.exit_code == code, result.output
    assert not isinstance(result.exception, Exception) or isinstance(result.exception, SystemExit)
    message = " ".join(result.stderr.split())
    assert "Traceback" not in message
    for text in texts:
        assert text in message
    assert not out.exists() or not out.is_dir()
    assert not list(out.parent.glob(".*tmp"))


def identified(out):
    return json.loads((out / "identification.json").read_text())


def test_identify_writes_numbers_model_and_report(files):
    model, record, out = files
    result = call("identify", model, record, "--out", out)
    assert result.exit_code == 0, result.output
    assert sorted(p.name for p in out.iterdir()) == ["identification.json", "model.toml", "report.html"]
    found = identified(out)
    assert found["schema"] == 1
    assert found["order"] == 6
    assert found["order_reason"]
    assert len(found["modes"]) == 3
    for mode in found["modes"]:
        assert {"frequency_hz", "damping_ratio", "pole", "mac", "emac", "mpc", "msv", "std"} <= set(mode)
        assert set(mode["std"]) == {"frequency_hz", "damping_ratio", "pole", "shape"}
        assert set(mode["shape"]) == {"s1", "s2", "s3"}
        assert len(mode["pole"]) == 2
    assert np.shape(found["poles"]) == (6, 2)
    for name in ("mass", "damping", "stiffness"):
        limit = 0.1 if name == "damping" else 0.02
        assert max(error(found[name], getattr(SYSTEM, name))) < limit
        assert np.shape(found["std"][name]) == (3, 3)
    for key in ("train_nrmse", "noise_floor"):
        assert set(found["fit"][key]) == {"s1", "s2", "s3"}
        assert all(0.009 < x < 0.011 for x in found["fit"][key].values())
    assert isinstance(found["warnings"], list)
    assert "<html" in (out / "report.html").read_text()
    assert "impulse response" in result.stderr

    predicted = out / "predicted.csv"
    result = call("simulate", out / "model.toml", record, "--out", predicted)
    assert result.exit_code == 0, result.output
    assert predicted.read_text().splitlines()[0] == "time,s1,s2,s3"
    y = np.loadtxt(predicted, delimiter=",", skiprows=1)
    truth = np.loadtxt(record, delimiter=",", skiprows=1)
    np.testing.assert_allclose(y[:, 0], truth[:, 0], atol=1e-9)
    assert (np.std(y[:, 1:] - truth[:, 2:], axis=0) / np.std(truth[:, 2:], axis=0)).max() < 0.011


@pytest.mark.slow
def test_without_refinement(files, columns):
    model, record, out = files
    result = call("identify", model, record, "--out", out, "--no-refine")
    assert result.exit_code == 0, result.output
    found = identified(out)
    assert found["std"] is found["elements"] is found["correlation"] is None
    assert found["refined"] is False
    for name in ("mass", "damping", "stiffness"):
        assert found[name] == found["cbsi"][name]
        limit = 0.1 if name == "damping" else 0.02
        assert max(error(found[name], getattr(SYSTEM, name))) < limit
    assert set(found["fit"]["cbsi_nrmse"]) == {"s1", "s2", "s3"}
    assert found["fit"]["matrices_nrmse"] is None
    assert any("Nothing was refined" in w for w in found["warnings"])
    assert "Nothing was refined" in " ".join(result.stdout.split())
    assert "CBSI alone" in " ".join(result.stdout.split())
    assert "nothing was refined" in (out / "report.html").read_text()
    predicted = out / "predicted.csv"
    assert call("simulate", out / "model.toml", record, "--out", predicted).exit_code == 0
    y, truth = (np.loadtxt(p, delimiter=",", skiprows=1) for p in (predicted, record))
    assert (np.std(y[:, 1:] - truth[:, 2:], axis=0) / np.std(truth[:, 2:], axis=0)).max() < 0.02
    two = write_csv(out.parent / "two.csv", {n: x for n, x in columns.items() if n != "s3"})
    other = out.parent / "two"
    assert call("identify", model, two, "--out", other, "--no-refine").exit_code == 0
    assert identified(other)["mass"] is identified(other)["fit"]["cbsi_nrmse"] is None
    assert not (other / "model.toml").exists()
    refused(call("identify", model, record, "--out", out / "x", "--no-refine", "--structure", "model"), out / "x", 2,
            "refine=False")  # fmt: skip


def test_quiet_says_nothing(files):
    model, record, out = files
    result = call("identify", model, record, "--out", out, "--quiet")
    assert (result.exit_code, result.output) == (0, "")
    assert identified(out)["order"] == 6


@pytest.mark.slow
def test_fewer_sensors_than_bodies_still_identify_with_a_warning(files, columns):
    model, _, out = files
    record = write_csv(out.parent / "two.csv", {n: x for n, x in columns.items() if n != "s3"})
    result = call("identify", model, record, "--out", out, "--structure", "free")
    assert result.exit_code == 0, result.output
    found = identified(out)
    assert found["mass"] is None
    assert found["std"] is None
    assert len(found["modes"]) == 3
    assert any("No sensor on b3" in w for w in found["warnings"])
    assert not (out / "model.toml").exists()


def test_the_structure_of_the_model_makes_up_for_sensors(files, columns):
    model, _, out = files
    record = write_csv(out.parent / "two.csv", {n: x for n, x in columns.items() if n != "s3"})
    result = call("identify", model, record, "--out", out)
    assert result.exit_code == 0, result.output
    found = identified(out)
    assert len(found["mass"]) == 3
    assert any("follow from the model's structure" in w for w in found["warnings"])
    values = {x["name"]: x["value"] for x in found["elements"]}
    model = read_model(out / "model.toml")
    assert values["b3.mass"] == float(model.mass[2])
    assert {x["quantity"] for x in found["elements"]} == {"mass", "damping", "stiffness"}
    assert all(x["std"] < abs(x["value"]) for x in found["elements"])


def test_no_input_on_a_sensed_body(files, columns):
    model, _, out = files
    record = write_csv(out.parent / "two.csv", {n: x for n, x in columns.items() if n != "s1"})
    result = call("identify", model, record, "--out", out, "--structure", "free")
    assert result.exit_code == 0, result.output
    assert any("No input acts on a sensed body" in w for w in identified(out)["warnings"])


def damaged(columns, name):
    c = {k: v.copy() for k, v in columns.items()}
    match name:
        case "missing column":
            del c["force"]
        case "no sensor":
            c = {k: c[k] for k in ("time", "force")}
        case "no time":
            del c["time"]
        case "milliseconds":
            c["time"] *= 1000
        case "gap":
            c = {k: np.delete(v, slice(500, 510)) for k, v in c.items()}
        case "backwards":
            c["time"] = c["time"][::-1]
        case "twice":
            c["time"][7] = c["time"][6]
        case "nan":
            c["s2"][12] = np.nan
        case "zero":
            c["force"] *= 0
        case "constant":
            c["force"] = 0 * c["force"] + 2.5
        case "dead":
            c["s2"] = 0 * c["s2"] + 0.3
        case "short":
            c = {k: v[:40] for k, v in c.items()}
        case "tone":
            c["force"] = np.sin(2 * np.pi * 10 * c["time"])
    return c


@pytest.mark.parametrize(
    ("name", "code", "texts"),
    [
        ("missing column", 2, ("record.csv", "'force'")),
        ("no sensor", 2, ("record.csv", "s1")),
        ("no time", 2, ("record.csv", "'time'", "rate")),
        ("milliseconds", 2, ("record.csv", "time", "ms")),
        ("gap", 2, ("record.csv", "time", "row")),
        ("backwards", 2, ("record.csv", "time", "row")),
        ("twice", 2, ("record.csv", "time", "row")),
        ("nan", 2, ("record.csv", "'s2'", "row")),
        ("zero", 2, ("record.csv", "'force'", "zero")),
        ("constant", 2, ("record.csv", "'force'", "constant")),
        ("dead", 2, ("record.csv", "'s2'", "dead")),
        ("short", 3, ("40 samples", "6 states")),
        ("tone", 3, ("record.csv", "band")),
    ],
)
def test_bad_records(files, columns, name, code, texts):
    model, _, out = files
    record = write_csv(out.parent / "record.csv", damaged(columns, name))
    refused(call("identify", model, record, "--out", out), out, code, *texts)


def test_two_inputs_that_are_one_signal(files, columns):
    model, _, out = files
    model.write_text(MODEL + '[[inputs]]\nname = "force2"\nbody = "b3"\n')
    record = write_csv(out.parent / "record.csv", {**columns, "force2": 2 * columns["force"]})
    refused(call("identify", model, record, "--out", out), out, 2, "'force'", "'force2'", "same signal")


@pytest.mark.parametrize(
    ("old", "new", "texts"),
    [
        ('body = "b2"', 'body = "b7"', ("'b7'", "b1, b2, b3")),
        ("b1 = 1.5", "b1 = -1.5", ("'b1'", "positive")),
        ('kind = "acceleration"', 'kind = "strain"', ("strain", "velocity")),
        ("[bodies]", "[bodies", ("model.toml", "line")),
        ('name = "three masses"', "", ()),
    ],
)
def test_bad_models(files, old, new, texts):
    model, record, out = files
    if not texts:
        model.write_bytes(b"\x80\xff\x00 not text")
    else:
        model.write_text(MODEL.replace(old, new, 1))
    refused(call("identify", model, record, "--out", out), out, 2, "model.toml", *texts)


def test_bad_places_and_options(files):
    model, record, out = files
    refused(call("identify", model, out.parent / "none.csv", "--out", out), out, 2, "none.csv")
    refused(call("identify", out.parent / "none.toml", record, "--out", out), out, 2, "none.toml")
    refused(call("identify", record, model, "--out", out), out, 2)
    refused(call("identify", model, record, "--out", out, "--method", "magic"), out, 2, "magic")
    refused(call("identify", model, record, "--out", out, "--nonsense"), out, 2, "--nonsense")
    refused(call("identify", model, record, "--out", out, "--order", "-2"), out, 2, "order")
    refused(call("identify", model, record, "--out", out, "--order", "0"), out, 2, "order")
    refused(call("identify", model, record, "--out", out, "--order", "5000"), out, 3, "5000 states")
    refused(call("identify", model, record, "--out", out, "--band", "60", "1"), out, 2, "band")
    refused(call("identify", model, record, "--out", out, "--band", "2000", "3000"), out, 2, "band")
    refused(call("simulate", model, out.parent / "none.csv", "--out", out), out, 2, "none.csv")
    folder = out.parent / "folder.csv"
    folder.mkdir()
    refused(call("identify", model, folder, "--out", out), out, 2, "folder.csv")
    binary = out.parent / "binary.csv"
    binary.write_bytes(bytes(range(256)) * 40)
    refused(call("identify", model, binary, "--out", out), out, 2, "binary.csv")
    out.write_text("a file")
    refused(call("identify", model, record, "--out", out), out, 2, "is a file")
    assert out.read_text() == "a file"


def test_older_results_survive_a_failure(files, columns):
    model, _, out = files
    out.mkdir()
    (out / "identification.json").write_text("old")
    record = write_csv(out.parent / "record.csv", damaged(columns, "zero"))
    assert call("identify", model, record, "--out", out).exit_code == 2
    assert [p.name for p in out.iterdir()] == ["identification.json"]
    assert (out / "identification.json").read_text() == "old"


def test_help_names_the_commands():
    result = call("--help")
    assert result.exit_code == 0
    for command in ("identify", "simulate", "demo"):
        assert command in result.output
        assert call(command, "--help").exit_code == 0


def test_a_real_process_ends_with_the_exit_code(files, columns):
    model, _, out = files
    record = write_csv(out.parent / "record.csv", damaged(columns, "missing column"))
    command = [sys.executable, "-m", "jaxsid.cli", "identify", str(model), str(record), "--out", str(out)]
    done = subprocess.run(command, capture_output=True, text=True, env=dict(os.environ), check=False)
    assert done.returncode == 2
    assert done.stdout == ""
    assert "'force'" in done.stderr
    assert "Traceback" not in done.stderr
    assert not out.exists()


def test_effects_are_listed_and_told_one_by_one(tmp_path):
    from jaxsid.mechanics.effects.catalogue import CATALOGUE

    listed = call("effects")
    assert listed.exit_code == 0
    for kind in CATALOGUE:
        one = call("effects", kind)
        assert one.exit_code == 0
        assert CATALOGUE[kind].source.split(",")[0] in one.output
    # what it says for the model file is one that can be read
    text = call("effects", "coulomb_friction").output
    lines = text[text.index("[[effects]]") :].replace('"body"', '"b1"')
    model = tmp_path / "model.toml"
    model.write_text(
        'name = "one"\n[bodies]\nb1 = 1.0\n[[inputs]]\nname = "f"\nbody = "b1"\n'
        '[[sensors]]\nname = "s"\nbody = "b1"\nkind = "velocity"\n' + lines
    )
    (effect,) = read_model(model).effects
    assert effect.kind == "coulomb_friction"
    # a form of a kind has a parameter more, which may be given too
    text = call("effects", "stribeck_friction").output
    assert "Canudas de Wit, H. Olsson" in text
    lines = text[text.index("[[effects]]") :].replace('"body"', '"b1"').replace("# stiffness", "stiffness")
    model.write_text(model.read_text().split("[[effects]]")[0] + lines)
    (effect,) = read_model(model).effects
    assert (effect.kind, float(effect.parameters["stiffness"])) == ("stribeck_friction", 1.0)
    unknown = call("effects", "backlsh")
    assert unknown.exit_code == 2
    assert "did you mean 'backlash'" in unknown.output
