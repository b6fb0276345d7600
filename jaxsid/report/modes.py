"""The modes of an identification one by one, each with its nominal counterpart; shapes, worst fits."""

from typing import NamedTuple

import numpy as np

from jaxsid.identification import Identification
from jaxsid.mechanics.lumped import GROUND, LumpedModel, second_order
from jaxsid.records import SecondOrderModel

INDICATORS = ("mac", "emac", "mpc", "cmi", "msv")


class Mode(NamedTuple):
    """A conjugate pair of poles, or one real pole.

    Attributes:
        index: of the pole with positive imaginary part among the poles of the model.
        pole, pole_std: 1/s; the deviation of the real part + 1j times that of the imaginary part.
        frequency, frequency_std: Hz.
        damping_ratio, damping_ratio_std: relative to critical.
        indicators: mac, emac, mpc, cmi and msv; NaN where unknown.
        nominal: the pole of the nominal model nearest to it, 1/s; None where there is none left.
    """

    index: int
    pole: complex
    pole_std: complex
    frequency: float
    frequency_std: float
    damping_ratio: float
    damping_ratio_std: float
    indicators: dict[str, float]
    nominal: complex | None

    @property
    def real(self) -> bool:
        return self.pole.imag == 0

    @property
    def nominal_frequency(self) -> float:
        return float("nan") if self.nominal is None else abs(self.nominal) / (2 * np.pi)

    @property
    def nominal_damping_ratio(self) -> float:
        return float("nan") if not self.nominal else -self.nominal.real / abs(self.nominal)


def upper(poles: np.ndarray) -> np.ndarray:
    """Indices of one pole of each pair and of every real pole, slowest first."""
    real = np.abs(np.imag(poles)) <= 1e-9 * np.abs(poles)
    return np.flatnonzero(real | (np.imag(poles) > 0))


def modes_of(found: Identification) -> tuple[Mode, ...]:
    """One entry for each conjugate pair and each real pole, slowest first."""
    poles = np.asarray(found.modal.poles)
    keep = upper(poles)
    indicators = found.modal.indicators
    values = {name: np.asarray(getattr(indicators, name)) for name in INDICATORS} if indicators else {}
    numbers = [
        np.asarray(x)
        for x in (
            found.modal.frequencies,
            found.frequency_std,
            found.modal.damping_ratios,
            found.damping_ratio_std,
        )
    ]
    nominal = nominal_poles(found.nominal)
    return tuple(
        Mode(
            int(i),
            _clean(complex(poles[i])),
            complex(np.asarray(found.pole_std)[i]),
            float(numbers[0][i] / (2 * np.pi)),
            float(numbers[1][i] / (2 * np.pi)),
            float(numbers[2][i]),
            float(numbers[3][i]),
            {name: float(values[name][i]) if values else float("nan") for name in INDICATORS},
            partner,
        )
        for i, partner in zip(keep, _partners(poles[keep], nominal), strict=True)
    )


def _clean(pole: complex) -> complex:
    """Without the imaginary part that rounding leaves on a real pole."""
    return complex(pole.real, 0.0) if abs(pole.imag) <= 1e-9 * abs(pole) else pole


def _partners(poles: np.ndarray, nominal: np.ndarray) -> list[complex | None]:
    """The nominal pole of each pole, nearest pairs first, each used once."""
    partners: list[complex | None] = [None] * len(poles)
    size = np.abs(poles)[:, None] + np.abs(nominal)[None]
    cost = np.abs(poles[:, None] - nominal[None]) / np.where(size > 0, size, 1)
    for _ in range(min(len(poles), len(nominal))):
        i, j = np.unravel_index(np.argmin(cost), cost.shape)
        partners[i] = complex(nominal[j])
        cost[i], cost[:, j] = np.inf, np.inf
    return partners


def nominal_poles(model: LumpedModel) -> np.ndarray:
    """Poles of the linear part of a model with imaginary part >= 0, slowest first, 1/s."""
    return poles_of(second_order(model))


def poles_of(model: SecondOrderModel) -> np.ndarray:
    """Eigenvalues of [[0, I], [-M^-1 K, -M^-1 D]] with imaginary part >= 0, slowest first, 1/s."""
    mass, damping, stiffness = (np.asarray(x, float) for x in (model.mass, model.damping, model.stiffness))
    size = len(mass)
    lower = np.linalg.solve(mass, -np.hstack([stiffness, damping]))
    poles = np.linalg.eigvals(np.vstack([np.eye(size, 2 * size, size), lower]))
    poles = poles[np.imag(poles) >= 0]
    return poles[np.argsort(np.abs(poles))]


def worst_fits(found: Identification, most: int = 20) -> list[int]:
    """Outputs in their order; where there are too many for a table, those that fit worst."""
    worst = np.argsort(-np.nan_to_num(np.asarray(found.train_nrmse)), kind="stable")[:most]
    return sorted(int(i) for i in worst)


def compared(found: Identification) -> list[tuple[str, np.ndarray]]:
    """Names and misfits of the models there are; the last is the one that is reported."""
    given = (
        ("Nominal model", found.nominal_nrmse),
        ("CBSI alone", found.cbsi_nrmse),
        ("Refined matrices", found.matrices_nrmse),
    )
    models = [(name, np.asarray(values)) for name, values in given if values is not None]
    last = np.asarray(found.train_nrmse)
    if found.matrices_nrmse is None or not np.array_equal(last, models[-1][1], equal_nan=True):
        models.append(("State-space model", last))
    return models


def connecting(found: Identification, which: str, between: tuple[str, str]) -> tuple[float, float]:
    """Stiffness or damping between two bodies, or a body and ground, as the matrix has it; its deviation.

    -K_ij, and for the ground the sum of row i.
    """
    values, deviation = np.asarray(getattr(found.matrices, which)), found.matrices_std
    rows = [found.nominal.bodies.index(end) for end in between if end != GROUND]
    if len(rows) == 1:
        row = values[rows[0]]
        total = float(row.sum())
        std = float("nan") if deviation is None else float(getattr(deviation, f"ground_{which}")[rows[0]])
        return total if abs(total) > 1e-9 * np.abs(row).sum() else 0.0, std
    i, j = rows
    std = float("nan") if deviation is None else float(np.asarray(getattr(deviation, which))[i, j])
    return -float(values[i, j]), std


def displacement_shapes(found: Identification, kinds: tuple[str, ...]) -> np.ndarray:
    """Mode shapes as displacement whatever the sensors measure, each with largest component 1.

    (outputs, n). A velocity is the displacement times the pole, an acceleration times its square.
    """
    poles, shapes = np.asarray(found.modal.poles), np.asarray(found.modal.shapes)
    power = np.array([("displacement", "velocity", "acceleration").index(kind) for kind in kinds])
    if len(set(kinds)) > 1:
        safe = np.where(poles == 0, 1, poles)
        shapes = shapes / safe[None] ** power[:, None]
    top = np.take_along_axis(shapes, np.argmax(np.abs(shapes), axis=0)[None], axis=0)
    return shapes / np.where(top == 0, 1, top)
