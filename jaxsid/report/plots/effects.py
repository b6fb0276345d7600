"""What a kind of effect does, in a picture: its force over displacement and velocity, or a signal before and after.

Every parameter is one standard deviation into its prior, and the place swings at one frequency.
"""

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from jaxsid.mechanics.effects.catalogue import scales
from jaxsid.mechanics.effects.kind import Changes, Kind, Motion, Nominal
from jaxsid.mechanics.effects.prior import Amplitudes
from jaxsid.report.style import BLUE, FONT, GREEN, INK, MUTED, ORANGE, label, legend, new_figure, style_axes

RATE, FORCE, DISPLACEMENT, DURATION = 2 * np.pi * 3.0, 10.0, 1e-3, 10.0
AT = Amplitudes(*map(jnp.asarray, (FORCE, DISPLACEMENT, RATE * DISPLACEMENT, 1.0, RATE, DURATION)))
SIZES = (0.6, 1.2, 1.8)  # of swings, in rms displacements
COLOURS = (GREEN, ORANGE, BLUE)
TURN = 2 * np.pi * np.arange(361) / 360
RINGS = np.linspace(0.01, 1.8, 25)  # of the map
SETTLE = 6  # turns after which a memory repeats itself


def effect_figure(kind: Kind) -> Figure:
    """A map of the force over displacement and velocity, and its course along swings; for signals, what becomes of one.

    Args:
        kind: one of the catalogue.
    """
    if kind.where in ("sensor", "input"):
        return _signal_figure(kind)
    if kind.where == "body" and kind.force is not None:
        return _time_figure(kind)
    return _force_figure(kind)


def example(kind: Kind) -> list[Array]:
    """Parameters at which the kind is well seen; where a factor or a value may be given, the factor.

    Args:
        kind: one of the catalogue.
    """
    ratios = {p.name: jnp.asarray(p.prior.example) for p in kind.parameters}
    sizes = scales(kind.name, AT, ratios)
    return [
        jnp.zeros(()) if p.name == "value" else ratios[p.name] * s
        for p, s in zip(kind.parameters, sizes, strict=True)
    ]


def force_along(kind: Kind, x: np.ndarray, v: np.ndarray, t: np.ndarray) -> np.ndarray:
    """Force of the kind's example along steady swings at `RATE`, at a place whose spring carries the rms force.

    Args:
        kind: one that acts between two ends or on a body.
        x: (samples, swings) displacement over one turn, m.
        v: velocity, m/s.
        t: time, s.
    """
    values, spring = example(kind), FORCE / DISPLACEMENT
    place, speed, time = (jnp.asarray(a) for a in (x, v, t))
    if kind.changes is not None:
        nominal = Nominal(*map(jnp.asarray, (spring / RATE**2, 0.05 * spring / RATE, spring)))
        return np.asarray(_linear_force(kind.changes(nominal, *values), place, speed))
    if kind.slip is not None:
        return np.asarray(kind.slip(jnp.abs(speed), *values) * jnp.sign(speed))
    assert kind.force is not None
    seen = Motion(place, speed, jnp.zeros_like(place), time, jnp.asarray(spring))
    if kind.rate is not None:
        seen = seen._replace(memory=_memory(kind, values, seen))
    return np.asarray(kind.force(seen, *values))


def _linear_force(change: Changes, x: Array, v: Array) -> Array:
    """Of added elements, and of an attached mass that swings along: x'' = -w^2 x."""
    force = change.stiffness * x + change.damping * v - change.mass * RATE**2 * x
    mass, joint = float(change.attached_mass), 0j
    if mass > 0:
        joint = complex(float(change.attached_stiffness), RATE * float(change.attached_damping))
        joint = mass * RATE**2 * joint / (joint - mass * RATE**2)
    return force + joint.real * x + joint.imag * v / RATE


def _memory(kind: Kind, values: list[Array], seen: Motion) -> Array:
    """The memory along a swing that has been going on, by Heun's method."""
    assert kind.rate is not None
    law, turn = kind.rate, len(seen.displacement) - 1
    step = 2 * np.pi / RATE / turn

    def rate(i: Array, z: Array) -> Array:
        now = Motion(seen.displacement[i], seen.velocity[i], z, seen.time[i], seen.spring)
        return law(now, *values)

    def advance(z: Array, k: Array) -> tuple[Array, Array]:
        i = k % turn
        first = rate(i, z)
        return z + 0.5 * step * (first + rate(i + 1, z + step * first)), z

    begin = jnp.zeros_like(seen.displacement[0])
    _, course = lax.scan(advance, begin, jnp.arange(SETTLE * turn + 1))
    return course[-turn - 1 :]


def _swings(sizes: np.ndarray, start: np.ndarray | float = 0.0) -> tuple[np.ndarray, ...]:
    x = DISPLACEMENT * np.sin(TURN)[:, None] * sizes
    return x, RATE * DISPLACEMENT * np.cos(TURN)[:, None] * sizes, start + TURN[:, None] / RATE + 0 * x


def _force_figure(kind: Kind) -> Figure:
    """The map over the plane of states, and the course of the force over each of its axes."""
    figure, axes = new_figure(
        kind.name, 4.6, rows=2, columns=2, ratios=(1.0, 1.25), between=0.62, beside=0.3, top=0.72
    )
    first, last = (force_along(kind, *_swings(np.array(SIZES), start)) for start in (0.0, DURATION))
    drifts = not np.allclose(first, last)
    start = np.array([0.0, 0.5, 1.0]) * DURATION
    x, v, t = _swings(np.full(3, SIZES[-1]), start) if drifts else _swings(np.array(SIZES))
    force = force_along(kind, x, v, t)
    said = [f"at {s:g} s" for s in start] if drifts else [f"{s:g} mm" for s in SIZES]
    for ax, across in zip(axes[0], (x, v), strict=True):
        for i, colour in enumerate(COLOURS):  # the smallest on top
            look = {"color": colour, "linewidth": 1.3, "label": said[i], "zorder": 5 - i}
            ax.plot(1e3 * across[:, i], force[:, i], **look)
    label(axes[0, 0], "displacement (mm)", "force (N)")
    label(axes[0, 1], "velocity (mm/s)")
    legend(axes[0, 1], 3)
    place = axes[1, 0].get_gridspec()[1, :]
    for ax in axes[1]:
        ax.remove()
    below = figure.add_subplot(place)
    style_axes(below)
    _map(figure, below, kind, DURATION if drifts else 0.0)
    return figure


def _map(figure: Figure, ax: Axes, kind: Kind, start: float) -> None:
    """Force over displacement and velocity, as it is along swings of all sizes."""
    x, v, t = _swings(RINGS, start)
    force = force_along(kind, x, v, t)
    most = float(np.abs(force).max())
    levels = np.linspace(-most, most, 14)
    shown = ax.contourf(1e3 * x, 1e3 * v, force, levels, cmap="RdBu_r")
    shown.set_rasterized(True)  # a twentieth of its outlines' size
    bar = figure.colorbar(shown, ax=ax, pad=0.02)
    bar.ax.tick_params(labelsize=FONT - 0.5, colors=MUTED, length=2.5, width=0.6)
    bar.outline.set_visible(False)  # type: ignore[operator]
    bar.set_ticks([round(f * most, 1 - int(np.floor(np.log10(most)))) for f in (-0.9, 0.0, 0.9)])
    bar.set_label("force (N)", fontsize=FONT, color=INK)
    label(ax, "displacement (mm)", "velocity (mm/s)")


def _time_figure(kind: Kind) -> Figure:
    figure, axes = new_figure(kind.name, 2.2)
    t = np.linspace(0.0, 1.0, 721)[:, None]
    force = force_along(kind, np.zeros_like(t), np.zeros_like(t), t)
    axes[0, 0].plot(t, force, color=BLUE, linewidth=1.3)
    axes[0, 0].set_ylim(min(0.0, 1.15 * force.min()), 1.15 * force.max())
    label(axes[0, 0], "time (s)", "force on the body (N)")
    return figure


def _signal_figure(kind: Kind) -> Figure:
    """A steady sine before and after, in time and one over the other."""
    assert kind.changes is not None
    change = kind.changes(Nominal(*[jnp.zeros(())] * 3), *example(kind))
    gain, offset, delay, lag, inverse = (
        float(x) for x in (change.gain, change.offset, change.delay, change.lag, change.inverse_limit)
    )
    most = 1 / inverse if inverse else np.inf
    angle = np.concatenate([TURN[:-1], 2 * np.pi + TURN])
    before = np.sqrt(2) * np.sin(angle)
    late = np.sqrt(2) * np.sin(angle - RATE * delay - np.arctan(RATE * lag)) / np.hypot(1.0, RATE * lag)
    after = np.clip(late, -most, most) * (1 + gain) + offset
    figure, axes = new_figure(kind.name, 2.5, columns=2, top=0.72, beside=0.62)
    axes[0, 0].plot(angle / RATE, before, color=MUTED, linewidth=1.9, label="before")
    axes[0, 0].plot(angle / RATE, after, color=BLUE, linewidth=1.1, label="after")
    label(axes[0, 0], "time (s)", "signal (its rms)")
    legend(axes[0, 0], 2)
    axes[0, 1].plot(before, before, color=MUTED, linewidth=0.8)
    axes[0, 1].plot(before, after, color=BLUE, linewidth=1.3)
    label(axes[0, 1], "before (rms)", "after (rms)")
    return figure
