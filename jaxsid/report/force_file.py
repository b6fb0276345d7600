"""The forces that a diagnosis found, as arrays for other programs."""

from pathlib import Path

import numpy as np

from jaxsid.gap.diagnose import Diagnosis


def write_forces(found: Diagnosis, path: Path) -> None:
    """Write forces.npz: for the i-th force place_i, record_i, time_i, force_i, deviation_i, displacement_i, velocity_i.

    Force (N or N m) on the second end of a place, its opposite on the first; for a sensor what is added to its reading.

    Args:
        found: a diagnosis; without places the file has no arrays.
        path: file to write.
    """
    maps = () if found.examination.locations is None else found.examination.locations.maps
    arrays = {}
    for i, one in enumerate(maps):
        arrays[f"place_{i}"] = np.array(one.place.label)
        arrays[f"record_{i}"] = np.array(one.record)
        for name in ("time", "force", "deviation", "displacement", "velocity"):
            arrays[f"{name}_{i}"] = np.asarray(getattr(one, name))
    np.savez_compressed(path, **arrays)
