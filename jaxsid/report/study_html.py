"""The report of a study: one HTML file that needs nothing else."""

from collections.abc import Sequence
from pathlib import Path

from jaxsid.files.atomic import write_atomically
from jaxsid.report.html import check_installed
from jaxsid.study.configuration import Study
from jaxsid.study.summary import Row


def write_study_report(study: Study, rows: Sequence[Row], path: Path | str) -> None:
    """Write report.html: findings first, then the evidence; the file is there whole or not at all.

    Args:
        study: what was run.
        rows: its summary.
        path: file to write.

    Raises:
        InputError: the folder is missing or cannot be written to; matplotlib or jinja2 is not installed.
    """
    check_installed("matplotlib", "jinja2")
    from jaxsid.report.study_page import study_page  # slow to load

    text = study_page(study, rows)
    write_atomically(path, lambda stream: stream.write(text))
