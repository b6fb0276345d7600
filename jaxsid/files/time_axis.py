"""The sampling interval of a record's time column, and what can be wrong with the column."""

from pathlib import Path

import numpy as np

from jaxsid.checks import bad_input, require

MIN_SAMPLES = 16
JITTER = 1e-3  # of the interval
RARE = 0.05  # of the steps: so few long ones are gaps
LONGEST, SHORTEST = 10.0, 1e-7  # s; beyond these the unit is probably not seconds
SIGNIFICANT = 12  # digits to which an interval is rounded, so that 0.002 s is 0.002 s
MOST_DECIMALS = 9
MOST_MILLISECONDS = 500.0  # a longer step than 2 Hz would have is probably in microseconds
TO_SECONDS = {"s": 1.0, "ms": 1e-3, "us": 1e-6}


def sampling_interval(time: np.ndarray, path: Path, column: str, first_row: int, unit: str | None) -> float:
    """The interval dt in s of a uniform time column: the slope of the line that fits it best.

    Uniform means that no sample is further from that line than 1e-3 dt or one unit of the last digit
    with which the column was written, whichever is larger.

    Args:
        time: (samples,) in the given unit.
        path, column, first_row: for messages; the row of the first sample.
        unit: "s", "ms", "us", or None for seconds, then questioned if the interval is improbable.

    Raises:
        InputError: NaN, unsorted, duplicated, with a gap, not uniform, too short, or probably not in seconds.
    """
    where = f"{path}: column '{column}'"
    time = np.asarray(time, dtype=time.dtype if time.dtype.kind == "f" else float)
    check_finite(time, where, first_row)
    require_length(len(time), str(path))
    digit = last_digit(time)
    time = time.astype(float)
    check_order(time, where, first_row)
    slope, residual = best_line(time)
    check_gaps(time, where, first_row)
    worst = int(np.argmax(np.abs(residual)))
    if abs(residual[worst]) > max(JITTER * slope, digit):
        bad_input(
            f"{where}: not uniform: row {worst + first_row} is {abs(residual[worst]):.3g} away from the "
            "best-fitting "
            f"uniform time (dt is {slope:.6g}). Resample the record to a uniform time before."
        )
    if unit is None:
        check_unit(time, slope, where, path)
    return rounded(slope * TO_SECONDS[unit or "s"])


def check_finite(values: np.ndarray, where: str, first_row: int) -> None:
    """Raise InputError naming the first row that is empty, NaN or infinite."""
    bad = np.flatnonzero(~np.isfinite(values))
    if bad.size:
        value = values[bad[0]]
        found = "is empty or not a number" if np.isnan(value) else "is infinite"
        bad_input(
            f"{where}, row {bad[0] + first_row}: {found} ({bad.size} such rows). Repair these rows or cut "
            "the record there."
        )


def require_length(samples: int, path: str) -> None:
    """Raise InputError for a record from which nothing can be learnt."""
    require(
        samples >= MIN_SAMPLES,
        f"{path}: {samples} samples are too short a record; at least {MIN_SAMPLES} are needed.",
    )


def check_order(time: np.ndarray, where: str, first_row: int) -> None:
    """Raise InputError at the first row that repeats a time or goes back."""
    step = np.diff(time)
    bad = np.flatnonzero(step <= 0)
    if not bad.size:
        return
    row = bad[0] + 1 + first_row
    if step[bad[0]] < 0:
        bad_input(
            f"{where}, row {row}: goes back from {time[bad[0]]:.9g} to {time[bad[0] + 1]:.9g}. Sort the "
            "rows by time, or "
            "split the file there if a second record starts."
        )
    bad_input(
        f"{where}, row {row}: repeats {time[bad[0]]:.9g} ({bad.size} repeats). Remove repeated rows, or "
        "write the time "
        "with more digits if it was rounded."
    )


def check_gaps(time: np.ndarray, where: str, first_row: int) -> None:
    """Raise InputError at the first of a few steps that leave out samples.

    Long steps that are many come from a time printed with few digits, or from no uniform time at all.
    """
    step = np.diff(time)
    usual = float(np.median(step))
    wide = np.flatnonzero(step > 1.5 * usual)
    if 0 < wide.size < RARE * step.size:
        bad_input(
            f"{where}: a gap of {step[wide[0]]:.6g} after row {wide[0] + first_row} (dt is {usual:.6g}): "
            f"split the file there into two records{f' ({wide.size} such gaps)' if wide.size > 1 else ''}."
        )


def check_unit(time: np.ndarray, dt: float, where: str, path: Path) -> None:
    """Raise InputError where seconds would make an improbable sampling rate."""
    counter = dt >= 1 and bool(np.all(time == np.rint(time)))
    if dt > LONGEST or counter:
        likely = "ms" if dt < MOST_MILLISECONDS else "us"
        words = {"ms": "milliseconds", "us": "microseconds"}[likely]
        bad_input(
            f"{where}: its step is {dt:.6g}, which in seconds is a rate of {1 / dt:.3g} Hz. It is probably "
            f"in {words}. "
            f'Say so in a TOML list of records:\n[[records]]\nfile = "{path.name}"\ntime_unit = "{likely}"\n'
            'or time_unit = "s" if it is in seconds after all, or rate = ... (Hz) if it only counts samples.'
        )
    require(
        dt >= SHORTEST,
        f"{where}: its step is {dt:.6g}, which in seconds is a rate of {1 / dt:.3g} Hz. Is it in hours or "
        "days? "
        "Convert it to seconds, or give it by a `scale` in a TOML list of records.",
    )


def best_line(time: np.ndarray) -> tuple[float, np.ndarray]:
    """Slope of the least-squares line through the samples, and their distances from it."""
    centred = np.arange(len(time)) - (len(time) - 1) / 2
    deviation = time - time.mean()
    slope = float((centred * deviation).sum() / (centred * centred).sum())
    return slope, deviation - slope * centred


def last_digit(time: np.ndarray) -> float:
    """The unit of the last digit with which the later times were written, 0 where they were not rounded.

    Only the later half counts: with a fixed number of significant digits these are the coarsest.
    """
    values = time[len(time) // 2 :].astype(float)
    spacing = float(np.spacing(np.abs(time).max()))
    for decimals in range(MOST_DECIMALS + 1):
        scaled = values * 10.0**decimals
        if np.all(np.abs(scaled - np.rint(scaled)) <= 1e-6 + 2 * spacing * 10.0**decimals):
            return max(10.0**-decimals, 4 * spacing)
    return 4 * spacing


def rounded(dt: float) -> float:
    """The interval to 12 significant digits."""
    return float(f"{dt:.{SIGNIFICANT}g}")
