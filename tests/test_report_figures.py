"""The figures show what they are given, and say in which unit."""

import dataclasses
import subprocess
import sys

import jax.numpy as jnp
import numpy as np
import pytest
from matplotlib.figure import Figure
from report_fixture import chain, identification, with_elements, without_matrices

from jaxsid.checks import InputError
from jaxsid.mechanics.first_order import physical_displacement_velocity
from jaxsid.mechanics.lumped import Sensor, lumped_model, second_order
from jaxsid.modes import modal
from jaxsid.report import plots
from jaxsid.report.findings import BY_ELEMENTS, matrices_section
from jaxsid.report.frame import Table, Text
from jaxsid.report.modes import connecting, displacement_shapes, modes_of
from jaxsid.report.style import new_figure, scaled

FIGURES = {
    "time": lambda found: plots.time_figure(found, "acc2"),
    "impulse": plots.impulse_figure,
    "frequency": lambda found: plots.frequency_figure(found, "acc2"),
    "singular values": plots.singular_value_figure,
    "stabilization": plots.stabilization_figure,
    "mode shapes": plots.mode_shape_figure,
    "mass": lambda found: plots.matrix_figure(found, "mass"),
    "poles": plots.pole_figure,
    "residuals": lambda found: plots.residual_figure(found, found.outputs),
}
COUNTS = {"number", "sensor", "body", "order of the model"}  # labels of axes that have no unit


@pytest.fixture(scope="module")
def found():
    return identification()


def lines(figure: Figure, axes: int, name: str) -> np.ndarray:
    """Ordinates of the curve of this label."""
    (line,) = [line for line in figure.axes[axes].lines if line.get_label() == name]
    return np.asarray(line.get_ydata())


@pytest.mark.parametrize("name", FIGURES)
def test_axes_carry_units(found, name):
    figure = FIGURES[name](found)
    shown = [ax for ax in figure.axes if ax.axison]
    labels = [text for ax in shown for text in (ax.get_xlabel(), ax.get_ylabel()) if text]
    assert all(ax.get_ylabel() or ax.images for ax in shown)
    assert shown[-1].get_xlabel() or shown[-1].images
    assert all(text in COUNTS or (text.endswith(")") and "(" in text) for text in labels)


@pytest.mark.parametrize("name", FIGURES)
def test_figures_do_not_need_every_part(found, name):
    if name == "mass":
        with pytest.raises(InputError, match="no matrices"):
            FIGURES[name](without_matrices(found))
    else:
        assert FIGURES[name](without_matrices(found)).axes


def test_no_figure_touches_pyplot():
    code = "import sys, jaxsid.report.identification_page; print('matplotlib.pyplot' in sys.modules)"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert result.stdout.strip() == "False"


def test_time_figure_shows_measured_model_and_residual(found):
    figure = plots.time_figure(found, "acc2")
    measured, modelled = np.asarray(found.records[0].y)[:, 1], np.asarray(found.predictions[0])[:, 1]
    for name, values in (("measured", measured), ("model", modelled)):
        assert lines(figure, 0, name).max() == values.max()
        assert lines(figure, 0, name).min() == values.min()
    residual = np.asarray(figure.axes[2].lines[0].get_ydata())
    assert residual.max() == (measured - modelled).max()
    assert np.abs(measured).max() in np.abs(lines(figure, 1, "measured"))


def test_frequency_figure_shows_three_responses(found):
    figure = plots.frequency_figure(found, "acc3")
    low, high = figure.axes[0].get_xlim()
    fit = found.frequency_fit[0]
    f = np.asarray(fit.frequencies)
    inside = (f >= low) & (f <= high)
    for name in ("measured", "realization", "matrices"):
        label = "state space" if name == "realization" else name
        values = np.abs(np.asarray(getattr(fit, name))[inside, 2, 0])
        assert np.array_equal(lines(figure, 0, label), values)
    marks = [line.get_xdata()[0] for line in figure.axes[0].lines if len(line.get_xdata()) == 2]
    assert marks == pytest.approx([mode.frequency for mode in modes_of(found)])
    assert "matrices" not in [
        line.get_label() for line in plots.frequency_figure(without_matrices(found), "acc3").axes[0].lines
    ]


def test_stabilization_diagram_shows_every_stable_pole(found):
    table = found.stabilization
    figure = plots.stabilization_figure(found)
    assert len(lines(figure, 0, "and shape")) == (table.stable & (table.damping_ratio > -0.02)).sum()
    assert any(set(line.get_ydata()) == {found.order} for line in figure.axes[0].lines)


def test_poles_of_nominal_model_and_of_matrices(found):
    """The stiffness of the nominal model is 0.9 of the true one, its damping the same."""
    frequencies = [mode.nominal_frequency for mode in modes_of(found)]
    expected = modal(physical_displacement_velocity(second_order(chain(0.9)))).frequencies[::2]
    assert frequencies == pytest.approx(np.asarray(expected) / (2 * np.pi), rel=1e-9)
    assert sorted(lines(plots.pole_figure(found), 0, "nominal")) == pytest.approx(
        sorted(mode.nominal.imag for mode in modes_of(found))
    )


def test_shapes_of_mixed_sensors_are_displacements(found):
    """Accelerations and velocities as displacements give the shape that displacement sensors see."""
    model, kinds = chain(1.0), ("displacement", "velocity", "acceleration")

    def seen(kinds):
        sensors = [Sensor(f"s{i}", body, kind) for i, (body, kind) in enumerate(zip(model.bodies, kinds))]  # noqa: B905
        other = dataclasses.replace(model, sensors=tuple(sensors))
        return modal(physical_displacement_velocity(second_order(other)))

    mixed = displacement_shapes(dataclasses.replace(found, modal=seen(kinds)), kinds)
    plain = displacement_shapes(
        dataclasses.replace(found, modal=seen(("displacement",) * 3)), ("displacement",) * 3
    )
    assert np.allclose(mixed, plain, rtol=1e-8, atol=1e-10)


def test_many_sensors_and_real_poles():
    """Forty sensors without names on the axis, a pole on the real axis."""
    bodies = [f"b{i}" for i in range(40)]
    sensors = [Sensor(f"s{i}", body, "velocity") for i, body in enumerate(bodies)]
    found, n = identification(), 3
    model = dataclasses.replace(
        found.modal,
        poles=jnp.array([-5.0 + 0j, -1 + 20j, -1 - 20j]),
        frequencies=jnp.array([5.0, 20.02, 20.02]),
        damping_ratios=jnp.array([1.0, 0.05, 0.05]),
        shapes=jnp.ones((40, n), complex),
        participation=jnp.ones((n, 1), complex),
        feedthrough=jnp.zeros((40, 1)),
        indicators=None,
    )
    nominal = lumped_model(bodies, np.ones(40), sensors=sensors, name="many")
    nan = jnp.full(n, jnp.nan)
    found = dataclasses.replace(
        found, nominal=nominal, outputs=tuple(s.name for s in sensors), modal=model, frequency_std=nan,
        damping_ratio_std=nan, pole_std=nan + 0j, matrices=None,
        shape_std=found.shape_std[:, :n],
    )  # fmt: skip
    assert [mode.real for mode in modes_of(found)] == [True, False]
    assert "real" in plots.mode_shape_figure(found).axes[0].get_title(loc="left")
    assert plots.pole_figure(found).axes


def test_fitted_elements_are_shown_with_what_is_known_of_them(found):
    fitted, read_off = (matrices_section(x) for x in (with_elements(found), found))
    assert fitted.blocks[0] == Text(BY_ELEMENTS)
    assert not any(isinstance(b, Table) for b in fitted.blocks)  # they have a section of their own
    table = next(b for b in read_off.blocks if isinstance(b, Table))
    names = [row[0] if isinstance(row[0], str) else row[0].text for row in table.rows]
    assert names == [*found.nominal.bodies, *(c.name for c in found.nominal.connections)]
    assert "Read off the matrices" in table.note


def test_elements_are_read_off_the_matrices(found):
    """The matrices of the fixture are 1.001 times the true stiffness, the deviation that of the entry."""
    value, std = connecting(found, "stiffness", ("middle", "base"))
    assert value == pytest.approx(30e3 * 1.001)
    assert std == pytest.approx(0.004 * 30e3 + 1e-3 * 70e3)
    assert connecting(found, "stiffness", ("top", "ground"))[0] == 0
    value, std = connecting(found, "stiffness", ("ground", "base"))
    assert value == pytest.approx(40e3 * 1.001)
    assert std == pytest.approx(0.006 * 70e3)


@pytest.mark.parametrize(
    ("which", "size", "text"),
    [("y", 999.0, "force (N)"), ("y", 1500.0, "force (10³ N)"), ("x", 1500.0, "force (N)")],
)
def test_a_vertical_axis_has_room_for_three_digits(which, size, text):
    _, axes = new_figure("Force", 2.0)
    scaled(axes[0, 0], which, "force (N)", size)
    assert getattr(axes[0, 0], f"get_{which}label")() == text
