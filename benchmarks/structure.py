"""jaxsid on the flexible structure: in-band observer response, ERA, and B and D refitted to the lines.

    .venv/bin/python benchmarks/structure.py OUT.json

Force and accelerations were sampled behind anti-alias filters, so the input between samples is the
band-limited one: hold "band". Taken as held at zero order, the record is explained best by a model with a pole
far outside the unit circle, whatever the tool.
"""

import json
import sys
import time

import flexible_structure as data
import jax
import numpy as np

import jaxsid
from jaxsid.impulse.lines import record_lines
from jaxsid.mechanics.simulate import estimate_initial_state
from jaxsid.realization.refit import refit_inputs

LAGS = (6, None)  # None: chosen by the estimator
SAMPLES, ROWS = 300, 60
ORDERS = (40, 50, 60)


def held_out_error(model: jaxsid.Realization, u: np.ndarray, y: np.ndarray) -> list[float]:
    """NRMSE of each output, the initial state fitted to the same first stretch as everybody's."""
    start = estimate_initial_state(model, u[: data.START], y[: data.START]).state
    return data.nrmse(np.asarray(jaxsid.simulate_linear(model, u, initial_state=start)), y).tolist()


def trials() -> list[dict]:
    """Every setting."""
    u, y, u_held, y_held = data.load()
    record = jaxsid.Record(u, y, 1 / data.RATE, hold="band", name="flexible structure")
    rows = []

    def note(words: str, model: jaxsid.Realization, seconds: float) -> None:
        wrong = held_out_error(model, u_held, y_held)
        rows.append({"setting": words, "nrmse": wrong, "seconds": seconds})
        print(
            f"{words}: {np.median(wrong):.3g}, {max(wrong):.3g}, {seconds:.1f} s", file=sys.stderr, flush=True
        )

    for lags in LAGS:
        begin = time.perf_counter()
        response = jaxsid.InBand(band=data.BAND, lags=lags)([record], SAMPLES)
        lines = record_lines([record], band=data.BAND)
        shared = time.perf_counter() - begin
        for order in ORDERS:
            begin = time.perf_counter()
            cols = (SAMPLES - 1) // 2
            model = jaxsid.era(response, order=order, rows=ROWS, cols=cols, method="svd")
            seconds = shared + time.perf_counter() - begin
            words = f"InBand({lags or 'default'} lags), era(order {order})"
            note(words, model, seconds)
            model = jax.block_until_ready(refit_inputs(model, lines))
            note(f"{words}, refit_inputs", model, shared + time.perf_counter() - begin)
    return rows


def main() -> None:
    jax.config.update("jax_enable_x64", True)
    found = {"reason": None, "trials": []}
    if data.data_file().exists():
        found["trials"] = trials()
    else:
        found["reason"] = "flexibleStructure.mat was not found; name its folder by JAXSID_DATA"
        print(found["reason"], file=sys.stderr)
    with open(sys.argv[1], "w") as file:
        json.dump(found, file)


if __name__ == "__main__":
    main()
