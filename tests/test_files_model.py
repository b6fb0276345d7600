"""The model file: what is written reads back equal, and every mistake is named by file, table and key."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxsid.checks import InputError
from jaxsid.files.model_toml import read_model, write_model
from jaxsid.mechanics.lumped import (
    Connection,
    Effect,
    Input,
    Matrices,
    Sensor,
    Tolerance,
    lumped_model,
)

DRIVE = """
name = "two-inertia drive"

[bodies]
motor = 0.0053
load = 0.18

[[connections]]
name = "gearbox"
between = ["motor", "load"]
stiffness = 9365.0
damping = 0.8268

[[inputs]]
name = "torque"
body = "motor"

[[sensors]]
name = "gyro"
body = "load"
kind = "velocity"

[[effects]]
kind = "coulomb_friction"
between = ["ground", "motor"]
force = 0.35
"""

positive = st.floats(1e-9, 1e9)
words = st.text(
    st.characters(blacklist_categories=("Cs", "Cc"), blacklist_characters='"'), min_size=1, max_size=8
)


def write(tmp_path, text):
    path = tmp_path / "model.toml"
    path.write_text(text, encoding="utf-8")
    return path


def message(tmp_path, text):
    with pytest.raises(InputError) as caught:
        read_model(write(tmp_path, text))
    assert "model.toml" in str(caught.value)
    return str(caught.value)


def test_reads_the_documented_example(tmp_path):
    model = read_model(write(tmp_path, DRIVE))
    assert model.name == "two-inertia drive"
    assert model.bodies == ("motor", "load")
    assert model.mass.tolist() == [0.0053, 0.18]
    assert model.connections == (Connection("gearbox", ("motor", "load")),)
    assert (model.stiffness.tolist(), model.damping.tolist()) == ([9365.0], [0.8268])
    assert model.inputs == (Input("torque", "motor", "zero"),)
    assert model.sensors == (Sensor("gyro", "load", "velocity"),)
    assert model.tolerance == Tolerance(0.005, 0.005, 0.05)
    (effect,) = model.effects
    assert (effect.kind, effect.place) == ("coulomb_friction", (("between", ("ground", "motor")),))
    assert float(effect.parameters["force"]) == 0.35


def test_reads_matrices(tmp_path):
    text = 'bodies = ["a", "b"]\n[matrices]\nmass = [[1, 0], [0, 2.0]]\ndamping = [[0, 0], [0, 0]]\n'
    model = read_model(write(tmp_path, text + "stiffness = [[3.0, -1.0], [-1.0, 1.0]]\n"))
    assert model.bodies == ("a", "b")
    assert model.matrices is not None
    np.testing.assert_array_equal(model.matrices.mass, [[1, 0], [0, 2]])
    np.testing.assert_array_equal(model.matrices.stiffness, [[3, -1], [-1, 1]])


@st.composite
def models(draw):
    bodies = draw(st.lists(words.filter(lambda w: w != "ground"), min_size=1, max_size=3, unique=True))
    names = draw(st.lists(words.filter(lambda w: w != "time"), min_size=3, max_size=5, unique=True))
    elements = draw(st.lists(st.tuples(words, positive, positive), max_size=3, unique_by=lambda e: e[0]))
    kinds = st.sampled_from(["displacement", "velocity", "acceleration"])
    hold = draw(st.sampled_from(["zero", "first", "band"]))
    effects = [
        Effect(
            "coulomb_friction", (("between", ("ground", bodies[0])),), {"force": jnp.asarray(draw(positive))}
        ),
        Effect("constant_load", (("body", bodies[-1]),), {"force": jnp.asarray(-draw(positive))}),
        Effect(
            "periodic_disturbance",
            (("body", bodies[0]),),
            {
                "amplitude": jnp.asarray(draw(positive)),
                "frequency_hz": jnp.asarray(draw(positive)),
                "phase": jnp.asarray(draw(st.lists(positive, min_size=1))),
            },
        ),
        Effect("sensor_gain", (("sensor", names[-1]),), {"factor": jnp.asarray(draw(positive))}),
    ]
    common = {
        "inputs": [Input(names[0], draw(st.sampled_from(bodies)), hold)],
        "sensors": [Sensor(name, draw(st.sampled_from(bodies)), draw(kinds)) for name in names[1:]],
        "tolerance": Tolerance(*draw(st.tuples(*[st.floats(0, 1)] * 3))),
        "effects": effects[: draw(st.integers(0, 4))],
        "name": draw(words),
    }
    if draw(st.booleans()):
        size = len(bodies)
        x = np.array(draw(st.lists(positive, min_size=3 * size, max_size=3 * size))).reshape(3, size)
        full = np.ones((size, size))
        matrices = Matrices(
            jnp.diag(x[0]), jnp.asarray(np.diag(x[1]) + full), jnp.asarray(np.diag(x[2]) + full)
        )
        return lumped_model(bodies, matrices=matrices, **common)
    return lumped_model(
        bodies,
        [draw(positive) for _ in bodies],
        [k for _, k, _ in elements],
        [d for _, _, d in elements],
        connections=[Connection(name, ("ground", draw(st.sampled_from(bodies)))) for name, _, _ in elements],
        **common,
    )


@settings(max_examples=40, deadline=None)
@given(model=models())
def test_what_is_written_reads_back_equal(model, tmp_path_factory):
    path = tmp_path_factory.mktemp("models") / "model.toml"
    write_model(model, path, header="First line.\nSecond line.")
    assert path.read_text(encoding="utf-8").startswith("# First line.\n# Second line.\nname = ")
    assert eqx.tree_equal(read_model(path), model)


@pytest.mark.usefixtures("single_precision")
def test_single_precision_is_written_in_few_digits_and_reads_back_equal(tmp_path):
    model = lumped_model(["a"], [0.1], inputs=[Input("f", "a")], sensors=[Sensor("x", "a", "velocity")])
    write_model(model, tmp_path / "model.toml")
    assert "a = 0.1\n" in (tmp_path / "model.toml").read_text()
    assert eqx.tree_equal(read_model(tmp_path / "model.toml"), model)


@pytest.mark.parametrize(
    ("old", "new", "parts"),
    [
        (
            "stiffness = 9365.0",
            "stifness = 9365.0",
            ["[[connections]] number 1 ('gearbox')", "'stifness'", "Did you mean 'stiffness'"],
        ),
        (
            "stiffness = 9365.0",
            'stiffness = "soft"',
            ["[[connections]] number 1", "key 'stiffness'", "'soft'"],
        ),
        ("stiffness = 9365.0", "stiffness = nan", ["key 'stiffness'", "finite"]),
        ("stiffness = 9365.0", "stiffness = true", ["key 'stiffness'", "True"]),
        ("stiffness = 9365.0", "stiffness = -3.0", ["stiffness of 'gearbox'", "-3"]),
        (
            'between = ["motor", "load"]',
            'between = ["motor"]',
            ["[[connections]] number 1 ('gearbox')", "'between'"],
        ),
        ('between = ["motor", "load"]', 'between = ["motor", "laod"]', ["gearbox", "'laod'", "load"]),
        ("motor = 0.0053", "motor = -0.0053", ["mass of 'motor'", "-0.0053"]),
        ("motor = 0.0053", 'motor = "light"', ["[bodies]", "key 'motor'", "'light'"]),
        ("motor = 0.0053", "ground = 0.0053", ["'ground' is reserved"]),
        ('kind = "velocity"', 'kind = "speed"', ["sensor 'gyro'", "'speed'", "velocity"]),
        ('kind = "velocity"\n', "", ["[[sensors]] number 1 ('gyro')", "key 'kind' is missing"]),
        ("[[sensors]]", "[[sensor]]", ["key 'sensor' is unknown", "Did you mean 'sensors'"]),
        ('name = "torque"', 'name = "gyro"', ["'gyro' is used twice"]),
        (
            "force = 0.35",
            'force = "much"',
            ["[[effects]] number 1 ('coulomb_friction')", "key 'force'", "'much'"],
        ),
        ("force = 0.35", 'body = "load"', ["[[effects]] number 1", "one place"]),
        ('between = ["ground", "motor"]\n', "", ["[[effects]] number 1", "one place", "none"]),
        ('name = "two-inertia drive"', 'bodies = ["motor"]', ["not valid TOML"]),
        ("motor = 0.0053", "motor = ", ["line 5"]),
        ("[[inputs]]", "[inputs]", ["key 'inputs'", "[[inputs]], in double brackets"]),
        ("[[inputs]]", "[tolerance]\nmas = 0.1\n[[inputs]]", ["[tolerance]", "'mas'", "Did you mean 'mass'"]),
        ("[[inputs]]", "[matrices]\nmass = [[1.0]]\n[[inputs]]", ["[matrices]", "'damping' is missing"]),
    ],
)
def test_mistakes_are_named(tmp_path, old, new, parts):
    assert old in DRIVE
    text = message(tmp_path, DRIVE.replace(old, new, 1))
    assert all(part in text for part in parts), text


MATRICES = 'bodies = ["a"]\n[matrices]\nmass = [[1.0]]\ndamping = [[0.1]]\nstiffness = [[5.0]]\n'


@pytest.mark.parametrize(
    ("old", "new", "parts"),
    [
        ("[[1.0]]", "[[1.0, 2.0]]", ["[matrices], key 'mass'", "1 rows of 1"]),
        ("[[1.0]]", '[["x"]]', ["[matrices], key 'mass.0.0'", "'x'"]),
        ("[[1.0]]", "[[-1.0]]", ["'mass'", "not positive definite"]),
        ('["a"]', "3", ["key 'bodies'", "list of names"]),
        (
            "[matrices]",
            "",
            ["key 'mass' is unknown", "key 'damping' is unknown", "key 'stiffness' is unknown"],
        ),
        ("[matrices]", '[[connections]]\nname = "c"\nbetween = ["ground", "a"]\n[matrices]', ["not both"]),
    ],
)
def test_mistakes_in_matrices_are_named(tmp_path, old, new, parts):
    text = message(tmp_path, MATRICES.replace(old, new, 1))
    assert all(part in text for part in parts), text


def test_all_mistakes_are_told_at_once(tmp_path):
    text = message(tmp_path, DRIVE.replace("stiffness", "stifness").replace('kind = "velocity"', "knid = 1"))
    assert "stifness" in text
    assert "knid" in text
    assert "'kind' is missing" in text


def test_a_missing_file_suggests_a_like_one(tmp_path):
    write(tmp_path, DRIVE)
    with pytest.raises(InputError, match=r"modle\.toml: there is no such file.*'model\.toml'"):
        read_model(tmp_path / "modle.toml")
    with pytest.raises(InputError, match="nor is there a folder"):
        read_model(tmp_path / "nowhere" / "model.toml")
    with pytest.raises(InputError, match="is a folder"):
        read_model(tmp_path)


def test_an_empty_or_binary_file_is_refused(tmp_path):
    assert "empty" in message(tmp_path, "")
    (tmp_path / "model.toml").write_bytes(b'name = "\xff\xfe"')
    with pytest.raises(InputError, match=r"model\.toml: is not UTF-8"):
        read_model(tmp_path / "model.toml")


def test_a_failing_write_leaves_nothing(tmp_path):
    model = read_model(write(tmp_path, DRIVE))
    with pytest.raises(InputError, match="no folder"):
        write_model(model, tmp_path / "nowhere" / "model.toml")
    assert [p.name for p in tmp_path.iterdir()] == ["model.toml"]
