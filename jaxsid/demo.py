"""The story that `jaxsid demo` tells, on the twin of a servo rig: what it is, and what is the matter with it later."""

import dataclasses
from collections.abc import Callable
from pathlib import Path

import numpy as np
from jaxtyping import Float

from jaxsid.examples import rig_model_nominal, rig_record
from jaxsid.examples.twin import SAMPLING_INTERVAL
from jaxsid.files.atomic import atomic_directory
from jaxsid.files.csv_out import write_record
from jaxsid.files.model_toml import write_model
from jaxsid.gap.diagnose import Diagnosis, diagnose
from jaxsid.identification import Identification
from jaxsid.mechanics.lumped import LumpedModel, Tolerance
from jaxsid.pipeline.identify import identify

LATER = "diagnosis"  # folder of what comes later
FRICTION = 0.5  # N m, between the motor and the ground
SAMPLES, BAND, LEVEL = 2048, (1.0, 120.0), 3.0  # of the later record; Hz, N m rms
KNOWN = Tolerance(mass=0.01, stiffness=0.01, damping=0.1)  # of a model that was identified


def run_demo(out: Path, seed: int, say: Callable[[str], None]) -> Identification:
    """Make a record of the rig's twin, keep it with the nominal model in `out`, and identify the rig from it.

    Args:
        out: folder for nominal.toml and record.csv.
        seed: of the noise.
        say: told what is going on.
    """
    say("simulating the rig: stepped sine of torque, 20 to 350 Hz")
    model, record = rig_model_nominal(), rig_record(seed)
    with atomic_directory(out) as draft:
        write_model(model, draft / "nominal.toml", header="Nominal model of the rig, before any measurement.")
        write_record(record, draft / "record.csv")
    return identify(model, record, progress=say)


def run_later(found: Identification, out: Path, seed: int, say: Callable[[str], None]) -> Diagnosis:
    """Make a record of the rig whose motor now rubs, keep it with the identified model, and ask what is the matter.

    Args:
        found: the rig as it was.
        out: folder for nominal.toml and record.csv.
        seed: of the noise.
        say: told what is going on.
    """
    say("simulating the rig again: its motor has begun to rub")
    model = later_model(found)
    record = rig_record(seed + 1, demand=later_torque(seed), friction=FRICTION, torque_noise=0.0)
    with atomic_directory(out) as draft:
        write_model(model, draft / "nominal.toml", header="The rig as it was identified.")
        write_record(record, draft / "record.csv")
    return diagnose(model, record, progress=say)


def later_model(found: Identification) -> LumpedModel:
    """The identified model as what is known of the rig from then on.

    Args:
        found: the identification.
    """
    known = found.nominal if found.identified is None else found.identified
    return dataclasses.replace(known, tolerance=KNOWN, name="rig, later")


def later_torque(seed: int) -> Float[np.ndarray, " samples"]:
    """Torque of the later record: a multisine of random phases.

    Args:
        seed: of the phases.
    """
    f = np.fft.rfftfreq(SAMPLES, SAMPLING_INTERVAL)
    phase = 2 * np.pi * np.random.default_rng(seed).random(len(f))
    u = np.fft.irfft(np.where((f >= BAND[0]) & (f <= BAND[1]), np.exp(1j * phase), 0), SAMPLES)
    return LEVEL * u / u.std()
