"""Lines of records beside a model: exact without effects, from any state, on free axes, and back in time."""

import jax.numpy as jnp
import numpy as np
import pytest
from gap_helpers import DT, chain, drive, exact, record

from jaxsid.gap.setting import element_directions
from jaxsid.gap.spectra import in_time, motion_under, parameter_columns, readings, spectra_of, to_lines
from jaxsid.mechanics.lumped import Connection, Input, Sensor, lumped_model
from jaxsid.physical.elements import element_matrices, with_values
from jaxsid.records import Record

MIXED = ((0, "acceleration"), (1, "displacement"), (2, "velocity"))


def transient_of(spectra, lines):
    """The state that explains lines through the free responses, and what it leaves."""
    free = np.asarray(spectra.free) * np.asarray(spectra.weight)[:, None, None]
    columns = free.reshape(-1, free.shape[2])
    target = (np.asarray(lines) * np.asarray(spectra.weight)[:, None]).ravel()
    stack = lambda x: np.concatenate([x.real, x.imag])  # noqa: E731
    norm = np.linalg.norm(columns, axis=0)
    state = np.linalg.lstsq(stack(columns / norm), stack(target), rcond=1e-12)[0] / norm
    return state, target - columns @ state


@pytest.mark.parametrize("samples", [600, 601])
def test_a_linear_record_is_explained_to_rounding(samples):
    u = drive(samples)
    y = exact(u, MIXED, start=[0.01, -0.02, 0.0, 0.1, 0.0, -0.3])
    spectra = spectra_of(chain(MIXED), record(u, y, MIXED))
    _, left = transient_of(spectra, spectra.y - spectra.response)
    assert np.abs(left).max() < 1e-9 * np.abs(np.asarray(spectra.y)).max()


def test_motion_reads_as_the_record_does():
    u = drive(600)
    y = exact(u, MIXED, start=[0.01, 0.0, 0.02, 0.0, 0.1, 0.0])
    spectra = spectra_of(chain(MIXED), record(u, y, MIXED))
    state, _ = transient_of(spectra, spectra.y - spectra.response)
    motion = motion_under(spectra, jnp.zeros((len(spectra.omega), 3), complex), jnp.asarray(state))
    np.testing.assert_allclose(in_time(spectra, readings(spectra, motion)), y, atol=1e-8 * np.abs(y).max())


def test_lines_and_signals_are_one():
    u = drive(600)
    spectra = spectra_of(chain(), record(u, exact(u)))
    signals = np.random.default_rng(0).standard_normal((600, 2))
    np.testing.assert_allclose(in_time(spectra, to_lines(spectra, jnp.asarray(signals))), signals, atol=1e-12)


def test_smooth_force_on_a_body_is_felt_as_the_model_says():
    """A force that both the input and the latent force may exert, smooth enough between samples."""
    u = drive(2048, periods=2)
    spectra = spectra_of(chain(), record(u, exact(u)))
    forces = jnp.zeros((len(spectra.omega), 3), complex).at[:, 0].set(spectra.u[:, 0])
    felt = jnp.einsum("lpf,lf->lp", spectra.forced, forces)
    hold = np.sinc(np.asarray(spectra.omega) * DT / 2 / np.pi)[
        :, None
    ]  # what holding takes away, beside half a delay
    delay = np.exp(-0.5j * np.asarray(spectra.omega) * DT)[:, None]
    low = np.asarray(spectra.omega) < 2 * np.pi * 8
    driven = np.asarray(spectra.response)[low]
    # the accelerometer on the driven body sees the held force at once, not late: leave it out
    error = np.abs((np.asarray(felt) * hold * delay)[low] - driven)[:, 1:]
    assert error.max() < 0.02 * np.abs(driven[:, 1:]).max()


@pytest.mark.parametrize("kind", ["displacement", "velocity", "acceleration"])
def test_columns_of_elements_are_derivatives(kind):
    """On all lines of a white input that jumps at every sample; forces of springs and dampers are nearly smooth."""
    kinds, step = tuple((body, kind) for body in range(3)), 1e-6
    model, u = chain(kinds), np.random.default_rng(0).standard_normal(800)
    given = record(u, exact(u, kinds), kinds)
    plain = spectra_of(model, given)
    none = jnp.zeros((len(plain.omega), 3), complex)
    motion = motion_under(plain, none, jnp.zeros(6))
    columns = np.asarray(parameter_columns(plain, motion, element_directions(model)))
    elements = element_matrices(model)
    for i, element in enumerate(elements.listed):
        values = np.asarray(elements.nominal) * (1 + step * (np.arange(9) == i))
        moved = spectra_of(with_values(model, jnp.asarray(values)), given)
        expected = (np.asarray(moved.response) - np.asarray(plain.response)) / step
        error = np.linalg.norm(columns[:, :, i] - expected) / np.linalg.norm(expected)
        assert error < (0.02 if element.quantity == "damping" else 0.003)


def test_a_free_body_has_no_drift():
    model = lumped_model(["m"], [2.0], inputs=[Input("f", "m")], sensors=[Sensor("x", "m", "displacement")])
    rng = np.random.default_rng(0)
    u = rng.standard_normal(500)
    x, v, y = 0.3, -1.0, []
    for push in u:
        y.append(x)
        x, v = x + DT * v + DT**2 * push / 4, v + DT * push / 2
    from jaxsid.records import Record

    spectra = spectra_of(model, Record(u[:, None], np.array(y), DT, inputs=("f",), outputs=("x",)))
    _, left = transient_of(spectra, spectra.y - spectra.response)
    assert float(spectra.weight[0]) == 0.0
    assert np.abs(left).max() < 1e-8 * np.abs(np.asarray(spectra.y)).max()


def test_absent_sensors_are_marked():
    u = drive(300)
    y = exact(u)
    y[:, 2] = np.nan
    spectra = spectra_of(chain(), record(u, y))
    assert spectra.present.tolist() == [1.0, 1.0, 0.0]
    assert np.isfinite(np.asarray(spectra.y)).all()


def test_the_line_of_a_free_axis_is_left_out_however_rounding_parts_its_poles():
    rng = np.random.default_rng(0)
    u = rng.standard_normal(400)
    for _ in range(20):
        mass, spring, damper = rng.uniform(0.005, 0.2, 2), 10 ** rng.uniform(1, 4), 10 ** rng.uniform(-3, 0)
        model = lumped_model(
            ("motor", "load"),
            mass,
            [spring],
            [damper],
            connections=[Connection("shaft", ("motor", "load"))],
            inputs=[Input("torque", "motor")],
            sensors=[Sensor("v", "motor", "velocity")],
        )
        found = spectra_of(model, Record(u[:, None], u[:, None], 1e-3, inputs=("torque",), outputs=("v",)))
        assert found.weight[0] == 0
        assert (np.asarray(found.weight)[1:] > 0).all()
        assert np.isfinite(np.asarray(found.forced)).all()
