"""jaxsid on the flexible structure: in-band observer response, then ERA, at several orders.

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
from jaxsid.mechanics.simulate import estimate_initial_state

LAGS = 6
SAMPLES, ROWS = 300, 60
ORDERS = (40, 50, 60)


def held_out_error(model: jaxsid.Realization, u: np.ndarray, y: np.ndarray) -> list[float]:
    """NRMSE of each output, the initial state fitted to the same first stretch as everybody's."""
    start = estimate_initial_state(model, u[: data.START], y[: data.START]).state
    return data.nrmse(np.asarray(jaxsid.simulate_linear(model, u, initial_state=start)), y).tolist()


def trials() -> list[dict]:
    """Every order."""
    u, y, u_held, y_held = data.load()
    record = jaxsid.Record(u, y, 1 / data.RATE, hold="band", name="flexible structure")
    begin = time.perf_counter()
    response = jaxsid.InBand(band=data.BAND, lags=LAGS)([record], SAMPLES)
    shared = time.perf_counter() - begin
    rows = []
    for order in ORDERS:
        begin = time.perf_counter()
        cols = (SAMPLES - 1) // 2
        model = jaxsid.era(response, order=order, rows=ROWS, cols=cols, method="svd")
        jax.block_until_ready(model.A)
        seconds = shared + time.perf_counter() - begin
        words = f"InBand({LAGS} lags), era(order {order})"
        rows.append({"setting": words, "nrmse": held_out_error(model, u_held, y_held), "seconds": seconds})
        print(f"{words}: median {np.median(rows[-1]['nrmse']):.3g}, {seconds:.1f} s", file=sys.stderr)
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
