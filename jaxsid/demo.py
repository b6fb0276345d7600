"""The story that `jaxsid demo` tells, on the twin of a servo rig."""

from collections.abc import Callable
from pathlib import Path

from jaxsid.examples import rig_model_nominal, rig_record
from jaxsid.files.atomic import atomic_directory
from jaxsid.files.csv_out import write_record
from jaxsid.files.model_toml import write_model
from jaxsid.identification import Identification
from jaxsid.pipeline.identify import identify


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
