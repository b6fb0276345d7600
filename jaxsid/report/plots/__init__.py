"""Figures of an identification, each a function that returns a matplotlib Figure, and of the kinds of effects."""

from jaxsid.report.plots.effects import effect_figure
from jaxsid.report.plots.frequency import frequency_figure
from jaxsid.report.plots.impulse import impulse_figure
from jaxsid.report.plots.matrices import matrix_figure
from jaxsid.report.plots.order import singular_value_figure, stabilization_figure
from jaxsid.report.plots.parameters import correlation_figure, parameter_figure
from jaxsid.report.plots.poles import pole_figure
from jaxsid.report.plots.residuals import residual_figure
from jaxsid.report.plots.shapes import mode_shape_figure
from jaxsid.report.plots.time import time_figure

__all__ = [
    "correlation_figure",
    "effect_figure",
    "frequency_figure",
    "impulse_figure",
    "matrix_figure",
    "mode_shape_figure",
    "parameter_figure",
    "pole_figure",
    "residual_figure",
    "singular_value_figure",
    "stabilization_figure",
    "time_figure",
]
