"""The command `jaxsid`. Progress goes to standard error; exit code 0 done, 2 bad input, 3 no answer in the data."""

import atexit
import gc
import os
import signal
import sys
import threading
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext, suppress
from enum import StrEnum
from importlib import import_module
from pathlib import Path
from types import FrameType
from typing import Annotated

import typer

# Before JAX and numpy load: cached programs log needless warnings, and threads slow the many small factorizations.
os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from jaxsid.checks import InsufficientDataError, JaxsidError

gc.set_threshold(
    100_000, 50, 50
)  # tracing makes many small objects that live on: seldom looks save a fifth of a run
atexit.register(gc.freeze)  # nor need they be visited when all ends

app = typer.Typer(
    help="From measured records of a mechanical system to its modes and its mass, damping and stiffness.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_show_locals=False,
)


class Method(StrEnum):
    """Estimators of the impulse response."""

    inband = "inband"
    fourier = "fourier"
    direct = "direct"
    wavelet = "wavelet"
    auto = "auto"


class Algorithm(StrEnum):
    """Realization algorithms."""

    era = "era"
    era_dc = "era_dc"


class Structure(StrEnum):
    """Whose mass, damping and stiffness."""

    auto = "auto"
    free = "free"
    model = "model"


class Initial(StrEnum):
    """Initial state of a record."""

    estimate = "estimate"
    rest = "rest"


ModelFile = Annotated[Path, typer.Argument(help="Model file (TOML): bodies, connections, inputs, sensors.")]
RecordFiles = Annotated[
    list[Path],
    typer.Argument(help="Records: CSV, NPZ, MAT, UFF 58, or a TOML list of records.", metavar="RECORD..."),
]
Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="No progress and no summary.")]


@app.command()
def identify(
    model: ModelFile,
    records: RecordFiles,
    out: Annotated[Path, typer.Option(help="Folder for identification.json, model.toml and report.html.")],
    order: Annotated[
        int | None, typer.Option(help="Number of states; default: what bodies and sensors promise.")
    ] = None,
    band: Annotated[
        tuple[float, float] | None,
        typer.Option(help="Lowest and highest frequency to use, Hz; default: found."),
    ] = None,
    method: Annotated[
        Method, typer.Option(help="Impulse-response estimator; auto compares on held-out samples.")
    ] = Method.inband,
    realization: Annotated[Algorithm, typer.Option(help="Realization algorithm.")] = Algorithm.era,
    initial: Annotated[Initial, typer.Option(help="Initial state of each record.")] = Initial.estimate,
    structure: Annotated[
        Structure,
        typer.Option(
            help="Mass, damping and stiffness: free symmetric, made of the model's elements, or these unless the "
            "records contradict them."
        ),
    ] = Structure.auto,
    refine: Annotated[
        bool,
        typer.Option(
            help="Fit mass, damping and stiffness to the records; without, those of CBSI alone, without standard "
            "deviations."
        ),
    ] = True,
    quiet: Quiet = False,
) -> None:
    """Impulse response, ERA or ERA/DC, modes, mass, damping and stiffness from records."""
    with _errors(), _progress(quiet) as say:
        say("loading")
        _numerics()
        from jaxsid.files.model_toml import read_model
        from jaxsid.files.record_file import read_records
        from jaxsid.pipeline.identify import identify as run

        nominal = read_model(model)
        measured = read_records(records, nominal)
        _load_meanwhile("pandas", "jaxsid.report.html", "jaxsid.report.identification_page")
        found = run(
            nominal,
            measured,
            order=order,
            band=band,
            method=_method(method, measured, say),
            realization=realization.value,
            initial=initial.value,
            structure=structure.value,
            refine=refine,
            progress=say,
        )
        _write(found, out, say)
    if not quiet:
        _summary(found, out)


@app.command()
def diagnose(
    model: ModelFile,
    records: RecordFiles,
    out: Annotated[
        Path,
        typer.Option(help="Folder for diagnosis.json, model.toml, forces.npz, next_input.csv, report.html."),
    ],
    initial: Annotated[
        Initial, typer.Option(help="Initial state of each record; rest warns where it is not.")
    ] = Initial.estimate,
    resume: Annotated[
        bool, typer.Option("--resume", help="Go on with a run for this folder that was cut off.")
    ] = False,
    quiet: Quiet = False,
) -> None:
    """Where the model and the records part, which effect causes it, and how far the gap shrinks with that effect."""
    with _errors(), _progress(quiet) as say:
        say("loading")
        _numerics()
        from jaxsid.files.atomic import nearest_folder
        from jaxsid.files.model_toml import read_model
        from jaxsid.files.record_file import read_records
        from jaxsid.gap.diagnose import diagnose as run
        from jaxsid.gap.resume import resumable

        nominal = read_model(model)
        given = read_records(records, nominal)
        with resumable(nearest_folder(out) / f".{out.name}.unfinished", resume=resume):
            found = run(nominal, given, initial=initial.value, progress=say)
            _write_diagnosis(found, out, say)
    if not quiet:
        _diagnosis_summary(found, out)


@app.command()
def simulate(
    model: ModelFile,
    record: Annotated[
        Path, typer.Argument(help="Record with the inputs: CSV, NPZ, MAT, UFF 58, or a TOML list.")
    ],
    out: Annotated[Path, typer.Option(help="CSV file to write: time and one column for each sensor.")],
    initial: Annotated[
        Initial, typer.Option(help="Initial state; estimate fits it to the sensors.")
    ] = Initial.rest,
    quiet: Quiet = False,
) -> None:
    """The model's response to a record's inputs."""
    with _errors(), _progress(quiet) as say:
        say("loading")
        _numerics()
        from jaxsid.files.csv_out import write_response
        from jaxsid.files.model_toml import read_model
        from jaxsid.files.record_file import read_record
        from jaxsid.mechanics.simulate import simulate as run

        lumped = read_model(model)
        measured = read_record(record, lumped)
        say("simulating")
        with warnings.catch_warnings(record=True) as said:
            warnings.simplefilter("always", UserWarning)
            y = run(lumped, measured, initial=initial.value)
        write_response(out, y, float(measured.dt), [s.name for s in lumped.sensors])
    for warning in said:
        typer.echo(f"warning: {warning.message}", err=True)
    if not quiet:
        typer.echo(f"{out}: {len(y)} samples of {len(lumped.sensors)} sensors", err=True)


@app.command()
def effects(
    kind: Annotated[str | None, typer.Argument(help="One kind in full; default: all, a line each.")] = None,
    out: Annotated[
        Path | None,
        typer.Option(
            help="A picture of this kind, .svg or .png; of all kinds, a folder for a page with pictures."
        ),
    ] = None,
) -> None:
    """Kinds of effects beyond the linear model that a model file may hold: friction, backlash, delays and others."""
    with _errors():
        if out is not None:
            _numerics()
            from jaxsid.report.effects_page import write_page, write_picture

            if kind is None:
                write_page(out)
            else:
                write_picture(kind, out)
            return
        from jaxsid.report.effects import print_effect, print_effects

        if kind is None:
            print_effects()
        else:
            print_effect(kind)


@app.command()
def demo(
    out: Annotated[Path, typer.Option(help="Folder for the records, the model and the report.")] = Path(
        "demo"
    ),
    seed: Annotated[int, typer.Option(help="Seed of the noise.")] = 0,
    brief: Annotated[
        bool, typer.Option("--brief", help="Leave out the diagnosis, which takes a minute or two.")
    ] = False,
    quiet: Quiet = False,
) -> None:
    """The whole story on the built-in rig: identify it, and find out what is the matter with it later."""
    with _errors(), _progress(quiet) as say:
        say("loading")
        _numerics()
        from jaxsid.demo import LATER, run_demo, run_later

        found, changed = run_demo(out, seed, say), None
        _write(found, out, say, later=None if brief else f"{LATER}/report.html")
        if not brief:
            changed = run_later(found, out / LATER, seed, say)
            _write_diagnosis(changed, out / LATER, say)
    if not quiet:
        _summary(found, out)
        if changed is not None:
            _diagnosis_summary(changed, out / LATER)


@app.command()
def study(
    file: Annotated[
        Path, typer.Argument(help="Study file (TOML): factors, noise, realizations.", metavar="STUDY.toml")
    ],
    out: Annotated[
        Path,
        typer.Option(
            help="Folder for results.parquet, summary.csv and report.html; a study begun there goes on."
        ),
    ],
    workers: Annotated[
        int | None, typer.Option(help="Processes on this machine; default: this one alone.")
    ] = None,
    scheduler: Annotated[
        str | None, typer.Option(help="Address of a dask scheduler whose workers compute, tcp://host:8786.")
    ] = None,
    quiet: Quiet = False,
) -> None:
    """How noise, sensors and settings spread what is identified: thousands of realizations of many cases."""
    with _errors(), _resumable(out) as heed, _study_view(quiet) as view:
        view.say("loading")
        _numerics(hurry=False)
        from jaxsid.report.study_html import write_study_report
        from jaxsid.study.configuration import read_study
        from jaxsid.study.engine import Progress, run_study
        from jaxsid.study.store import open_store
        from jaxsid.study.tables import write_tables

        plan = read_study(file)
        with open_store(out, plan) as store, _workers(workers, scheduler) as execute:

            def progress(at: Progress) -> None:
                view.progress(at)
                heed()

            run_study(plan, store, execute=execute, progress=progress, say=view.say)
            view.say("tables and report")
            rows = write_tables(plan, store)
            write_study_report(plan, rows, store / "report.html")
    if not quiet:
        from jaxsid.report.study_terminal import print_study

        print_study(plan, rows)
        typer.echo(f"\nWritten to {out}: results.parquet, summary.parquet, summary.csv, report.html")


def _study_view(quiet: bool):
    """Progress of a study, once all that it needs is known to be there."""
    from jaxsid.report.html import check_installed

    check_installed("dask", "distributed", "pyarrow", user="A study", extra="study")
    check_installed("matplotlib", "jinja2")
    from jaxsid.report.study_terminal import study_view

    return study_view(quiet)


def _workers(count: int | None, scheduler: str | None):
    """What does the jobs of a study: this process, processes of this machine, or those of a scheduler."""
    if count is None and scheduler is None:
        from jaxsid.study.engine import in_process

        return nullcontext(in_process)
    from jaxsid.checks import require
    from jaxsid.study.cluster import local_workers, remote_workers

    require(count is None or scheduler is None, "--workers and --scheduler exclude each other.")
    return local_workers(count) if count is not None else remote_workers(str(scheduler))


@contextmanager
def _resumable(out: Path) -> Iterator[Callable[[], None]]:
    """An interrupt is no failure: what is done is kept. Yields what raises it again should a library swallow it."""
    asked = []

    def hear(number: int, frame: FrameType | None) -> None:
        asked.append(number)
        raise KeyboardInterrupt

    def heed() -> None:
        if asked:
            raise KeyboardInterrupt

    mine = threading.current_thread() is threading.main_thread()
    before = signal.signal(signal.SIGINT, hear) if mine else None
    try:
        yield heed
        heed()
    except KeyboardInterrupt:
        typer.echo(
            f"jaxsid: stopped. What was done is kept in {out}; the same command goes on from there.", err=True
        )
        raise typer.Exit(130) from None
    finally:
        if mine:
            signal.signal(signal.SIGINT, before)


def _numerics(*, hurry: bool = True) -> None:
    """Double precision, and compiled programs kept on disk so that the next run starts at once."""
    import jax

    from jaxsid.compilation import default_folder, keep_programs

    jax.config.update("jax_enable_x64", True)
    keep_programs(default_folder(), hurry=hurry)


def _method(choice: Method, records, say):
    from jaxsid.impulse.direct import Direct
    from jaxsid.impulse.fourier import Fourier
    from jaxsid.impulse.select import select_method
    from jaxsid.impulse.wavelet import Wavelet

    if choice is Method.inband:
        return None
    if choice is Method.auto:
        say("comparing estimators on held-out samples")
        selection = select_method(records)
        typer.echo(selection.reason, err=True)
        return selection.method
    return {Method.fourier: Fourier, Method.direct: Direct, Method.wavelet: Wavelet}[choice]()


def _load_meanwhile(*modules: str) -> None:
    """Load what is needed later while the main thread waits for results: a twentieth of a warm run."""

    def load() -> None:
        for name in modules:
            with suppress(ImportError):  # said where it is needed
                import_module(name)

    threading.Thread(target=load, daemon=True).start()


def _write(found, out: Path, say, later: str | None = None) -> None:
    """All files, or none."""
    from jaxsid.files.atomic import atomic_directory
    from jaxsid.files.model_toml import write_model
    from jaxsid.files.results_json import write_json
    from jaxsid.report.html import write_report
    from jaxsid.report.results import identification_json

    say("report")
    with atomic_directory(out) as draft:
        write_json(draft / "identification.json", identification_json(found))
        if found.identified is not None:
            write_model(
                found.identified, draft / "model.toml", header="Identified by jaxsid from measured records."
            )
        write_report(found, draft / "report.html", later=later)


def _write_diagnosis(found, out: Path, say) -> None:
    """All files, or none."""
    from jaxsid.files.atomic import atomic_directory
    from jaxsid.files.csv_out import write_record
    from jaxsid.files.model_toml import write_model
    from jaxsid.files.results_json import write_json
    from jaxsid.report.force_file import write_forces
    from jaxsid.report.html import write_diagnosis_report

    say("report")
    with atomic_directory(out) as draft:
        write_json(draft / "diagnosis.json", found.as_dict())
        write_model(
            found.model,
            draft / "model.toml",
            header="Numbers refitted and effects found by jaxsid in measured records.",
        )
        write_forces(found, draft / "forces.npz")
        if found.experiment is not None:
            write_record(found.experiment.record, draft / "next_input.csv")
        write_diagnosis_report(found, draft / "report.html")
    if found.experiment is None:
        (out / "next_input.csv").unlink(missing_ok=True)  # of an older run


def _summary(found, out: Path) -> None:
    from jaxsid.report.summary import print_summary

    print_summary(found)
    names = ["identification.json", *(["model.toml"] if found.identified is not None else []), "report.html"]
    typer.echo(f"\nWritten to {out}: {', '.join(names)}")


def _diagnosis_summary(found, out: Path) -> None:
    from jaxsid.report.diagnosis_summary import print_diagnosis

    print_diagnosis(found)
    names = ["diagnosis.json", "model.toml", "forces.npz", "report.html"]
    names += ["next_input.csv"] if found.experiment is not None else []
    typer.echo(f"\nWritten to {out}: {', '.join(names)}")


@contextmanager
def _progress(quiet: bool) -> Iterator:
    """A line that says what is going on, on standard error; plain lines where that is no terminal."""
    if quiet:
        yield lambda text: None
        return
    from rich.console import Console

    console = Console(stderr=True)
    if not console.is_terminal:
        yield lambda text: typer.echo(f"jaxsid: {text} ...", err=True)
        return
    with console.status("loading") as status:
        yield lambda text: status.update(f"{text} ... (the first run on a machine also compiles)")


@contextmanager
def _errors() -> Iterator[None]:
    """One clear message and the exit code for errors that are the input's."""
    try:
        yield
    except JaxsidError as error:
        typer.secho(f"jaxsid: {error}", fg="red" if sys.stderr.isatty() else None, err=True)
        raise typer.Exit(3 if isinstance(error, InsufficientDataError) else 2) from None


if __name__ == "__main__":
    app()
