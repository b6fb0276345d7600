"""Reports: one HTML file each that needs nothing else."""

from importlib.util import find_spec
from pathlib import Path

from jaxsid.checks import require
from jaxsid.files.atomic import write_atomically
from jaxsid.gap.diagnose import Diagnosis
from jaxsid.identification import Identification


def write_report(found: Identification, path: Path | str, *, later: str | None = None) -> None:
    """Write report.html: findings first, then the evidence; the file is there whole or not at all.

    Args:
        found: what was identified.
        path: file to write.
        later: address of the report of a diagnosis with this model, to be pointed to.

    Raises:
        InputError: the folder is missing or cannot be written to; matplotlib or jinja2 is not installed.
    """
    check_installed("matplotlib", "jinja2")
    from jaxsid.report.identification_page import report_page  # slow to load

    text = report_page(found, later)
    write_atomically(path, lambda stream: stream.write(text))


def write_diagnosis_report(found: Diagnosis, path: Path | str) -> None:
    """The same of a diagnosis; arguments and errors as of `write_report`."""
    check_installed("matplotlib", "jinja2")
    from jaxsid.report.diagnosis_page import diagnosis_page  # slow to load

    text = diagnosis_page(found)
    write_atomically(path, lambda stream: stream.write(text))


def check_installed(*packages: str, user: str = "The report", extra: str = "plot") -> None:
    """Raise InputError where a package is missing that `user` needs and that the extra `extra` installs."""
    missing = [name for name in packages if find_spec(name) is None]
    require(
        not missing,
        f'{user} needs {" and ".join(missing)}, not installed here. In a checkout of jaxsid: pip install ".[{extra}]".',
    )
