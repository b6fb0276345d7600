"""What `identification.json` holds."""

from typing import Any

import numpy as np

from jaxsid.files.results_json import SCHEMA, plain
from jaxsid.identification import Identification
from jaxsid.mechanics.units import sensor_kinds
from jaxsid.physical.elements import ElementValues
from jaxsid.pipeline.misses import Peaks, cross_peaks, own_peaks
from jaxsid.records import SecondOrderModel
from jaxsid.report.modes import displacement_shapes, modes_of

MATRICES = ("mass", "damping", "stiffness")


def identification_json(found: Identification) -> dict[str, Any]:
    """The identification in the types of JSON, by the schema of `identification.json`.

    Frequencies in Hz, poles in 1/s as [real, imaginary], matrices in the order of `bodies`, null where they
    could not be found. What is not a number is null.
    """
    data = {
        "schema": SCHEMA,
        "name": found.nominal.name,
        "order": found.order,
        "order_reason": found.order_reason,
        "modes": _modes(found),
        "poles": np.asarray(found.modal.poles),
        **_matrices(found.matrices),
        "std": None if found.matrices_std is None else _matrices(found.matrices_std),
        "elements": None if found.elements is None else elements_json(found.elements),
        "fit": {
            "train_nrmse": _by_name(found.outputs, found.train_nrmse),
            "noise_floor": _by_name(found.outputs, found.noise_floor),
            "nominal_nrmse": _by_name(found.outputs, found.nominal_nrmse),
            "cbsi_nrmse": None if found.cbsi_nrmse is None else _by_name(found.outputs, found.cbsi_nrmse),
            "matrices_nrmse": None
            if found.matrices_nrmse is None
            else _by_name(found.outputs, found.matrices_nrmse),
        },
        "refined": found.refined,
        "correlation": _correlation(found),
        "residuals": _residuals(found),
        "warnings": list(found.warnings),
        "bodies": list(found.nominal.bodies),
        "sensors": list(found.outputs),
        "inputs": list(found.records[0].inputs) if found.records else [],
        "cbsi": None if found.cbsi is None else _cbsi(found.cbsi),
        "impulse_response": _impulse_response(found),
        "state_space": {name: np.asarray(getattr(found.continuous, name)) for name in "ABCD"},
        "records": [_record(record) for record in found.records],
    }
    return plain(data, "identification")


def _modes(found: Identification) -> list[dict[str, Any]]:
    shapes = displacement_shapes(found, sensor_kinds(found.nominal, found.outputs))
    spread = np.asarray(found.shape_std)
    return [
        {
            "frequency_hz": mode.frequency,
            "damping_ratio": mode.damping_ratio,
            "pole": mode.pole,
            "shape": dict(zip(found.outputs, shapes[:, mode.index], strict=True)),
            **mode.indicators,
            "std": {
                "frequency_hz": mode.frequency_std,
                "damping_ratio": mode.damping_ratio_std,
                "pole": mode.pole_std,
                "shape": dict(zip(found.outputs, spread[:, mode.index], strict=True)),
            },
        }
        for mode in modes_of(found)
    ]


def _matrices(holder: Any) -> dict[str, Any]:
    return {name: None if holder is None else np.asarray(getattr(holder, name)) for name in MATRICES}


def elements_json(elements: ElementValues) -> list[dict[str, Any]]:
    """One record for each value; a standard deviation of null is unknown, that is infinite.

    Args:
        elements: values of a model's elements.
    """
    columns = (np.asarray(x).tolist() for x in (elements.values, elements.deviation, elements.nominal))
    return [
        {"name": x.name, "element": x.element, "quantity": x.quantity}
        | {"value": value, "std": std, "nominal": nominal}
        for x, value, std, nominal in zip(elements.listed, *columns, strict=True)
    ]


def _correlation(found: Identification) -> dict[str, Any] | None:
    """Of the errors of the elements, or of the largest entries of matrices that are not made of them."""
    values = found.elements or found.entries
    if values is None:
        return None
    return {"names": [x.name for x in values.listed], "values": np.asarray(values.correlation)}


def _residuals(found: Identification) -> list[dict[str, Any]]:
    """The strongest correlations of what is left of each record with itself and with each input."""
    peaks = zip(
        found.records, own_peaks(found.residuals), cross_peaks(found.residuals), strict=bool(found.residuals)
    )
    return [
        {
            "record": record.name,
            "sensors": {
                name: {
                    "autocorrelation": _peak(own, row),
                    "inputs": {given: _peak(cross, (row, j)) for j, given in enumerate(record.inputs)},
                }
                for row, name in enumerate(found.outputs)
                if name in record.outputs
            },
        }
        for record, own, cross in peaks
    ]


def _peak(peaks: Peaks, at: Any) -> dict[str, Any]:
    """Value, lag and size in standard deviations of chance; whether chance explains it."""
    score = float(peaks.score[at])
    return {
        "value": float(peaks.value[at]),
        "lag_s": float(peaks.lag[at]),
        "score": score,
        "limit": peaks.limit,
        "by_chance": score <= peaks.limit if np.isfinite(score) else None,
    }


def _by_name(names: tuple[str, ...], values: Any) -> dict[str, float]:
    return dict(zip(names, np.asarray(values).tolist(), strict=True))


def _cbsi(model: SecondOrderModel) -> dict[str, Any]:
    diagnostics = model.diagnostics
    values = {} if diagnostics is None else {k: float(v) for k, v in vars(diagnostics).items()}
    return {**_matrices(model), "diagnostics": values}


def _impulse_response(found: Identification) -> dict[str, Any]:
    response = found.response
    return {
        "method": response.method,
        "band_hz": response.band,
        "interval_s": float(response.dt),
        "laguerre_pole": float(response.pole),
        "noise_std": response.noise_std,
    }


def _record(record: Any) -> dict[str, Any]:
    return {
        "name": record.name,
        "samples": len(record.y),
        "interval_s": float(record.dt),
        "inputs": list(record.inputs),
        "outputs": list(record.outputs),
    }
