"""The page: one file, complete, escaped, that fetches nothing."""

import dataclasses
import re
from html.parser import HTMLParser

import jax.numpy as jnp
import numpy as np
import pytest
from report_fixture import WARNING, identification, without_matrices

from jaxsid.checks import InputError
from jaxsid.digits import with_std
from jaxsid.mechanics.lumped import Input, Sensor, lumped_model
from jaxsid.records import ImpulseResponse, Record
from jaxsid.report.frame import (
    Card,
    Cards,
    Cell,
    Gallery,
    Link,
    Links,
    Notice,
    Section,
    Table,
    Text,
    page,
    picture,
)
from jaxsid.report.html import check_installed, write_report
from jaxsid.report.identification_page import report_page
from jaxsid.report.modes import modes_of
from jaxsid.report.plots import pole_figure

VOID = {"meta", "br", "img", "link", "input", "hr"}
FETCHES = {"src", "srcset", "data", "poster", "action", "background"}


class Reader(HTMLParser):
    """Text, tags, names and addresses of a page; fails where a tag is not closed in order."""

    def __init__(self, html: str):
        super().__init__()
        self.open, self.text, self.tags, self.ids, self.links, self.fetched = [], "", [], [], [], []
        self.feed(html)
        assert not self.open

    def handle_starttag(self, tag, attrs):
        self.handle_startendtag(tag, attrs)
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attrs):
        self.tags.append(tag)
        for name, value in attrs:
            if name == "id":
                self.ids.append(value)
            if name in ("href", "xlink:href"):
                (self.links if tag == "a" else self.fetched).append(value)
            if name in FETCHES:
                self.fetched.append(value)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.text += data


@pytest.fixture(scope="module")
def found():
    return identification()


@pytest.fixture(scope="module")
def html(found):
    return report_page(found)


@pytest.fixture(scope="module")
def reader(html):
    return Reader(html)


def test_findings_are_on_the_page(reader, found):
    for mode in modes_of(found):
        assert with_std(mode.frequency, mode.frequency_std) in reader.text
        assert with_std(100 * mode.damping_ratio, 100 * mode.damping_ratio_std) in reader.text
    for i, j in np.ndindex(3, 3):
        assert (
            with_std(float(found.matrices.stiffness[i, j]), float(found.matrices_std.stiffness[i, j]))
            in reader.text
        )
    assert found.nominal.name in reader.text
    assert found.order_reason in reader.text
    assert "sweep.csv" in reader.text
    assert "Stiffness (N/m)" in reader.text


def test_warnings_are_shown_and_escaped(reader, html):
    assert WARNING in reader.text
    assert "<noisy>" not in html
    assert "<chain>" not in html


def test_nothing_is_fetched(reader, html):
    assert "script" not in reader.tags
    assert "@import" not in html
    assert re.findall(r"url\((?!#)", html) == []
    assert all(address.startswith(("#", "data:")) for address in reader.fetched)
    assert all(address.startswith(("#", "https://doi.org/")) for address in reader.links)
    assert "http" not in re.sub(r'href="https://doi.org/[^"]+"', "", html)


def test_names_are_unique_and_links_lead_somewhere(reader, html):
    assert len(reader.ids) == len(set(reader.ids))
    inside = [a[1:] for a in (*reader.links, *reader.fetched) if a.startswith("#")]
    assert set(inside) | set(re.findall(r"url\(#([^)]+)\)", html)) <= set(reader.ids)


def test_figures_follow_the_colours_of_the_page(html):
    drawings = re.findall(r"<svg.*?</svg>", html, re.DOTALL)
    assert len(drawings) == 12  # 3 in time, 3 in frequency, shapes, poles, order twice, impulse, residuals
    for drawing in drawings:
        assert 'role="img"' in drawing
        assert "var(--ink)" in drawing
        assert not re.search(r"#(1d2733|66727f|0072b2)|: black|<text[^>]*#000000", drawing)


def test_text_of_figures_is_text(reader):
    for label in ("frequency (Hz)", "coherence (-)", "time (s)", "imaginary part (rad/s)"):
        assert label in reader.text


def test_a_long_record_makes_a_small_file(tmp_path):
    path = tmp_path / "report.html"
    write_report(identification(20_000), path)
    assert path.stat().st_size < 1_500_000


def test_report_without_matrices_and_indicators(found):
    text = Reader(report_page(without_matrices(found))).text
    assert "do not determine the matrices" in text
    assert "MPC" not in text.split("How it was computed")[0]


def test_report_with_nothing_but_modes(found):
    """No warnings, frequency responses, residuals, NaN for what is unknown, a Laguerre basis, an absent sensor."""
    unknown = jnp.full(3, np.nan)
    y = np.asarray(found.records[0].y)[:, :2]
    record = Record(found.records[0].u, y, 0.005, inputs=("force",), outputs=("acc1", "acc2"), name="roving")
    bare = dataclasses.replace(
        without_matrices(found), frequency_fit=(), warnings=(), train_nrmse=unknown, noise_floor=unknown,
        nominal_nrmse=unknown, residuals=(),
        records=(record, record), predictions=found.predictions * 2,
        response=ImpulseResponse(found.response.h, 0.005, pole=0.8),
        frequency_std=jnp.full(6, jnp.nan), damping_ratio_std=jnp.full(6, jnp.nan),
        pole_std=jnp.full(6, jnp.nan + 0j), shape_std=jnp.full((3, 6), jnp.nan + 0j),
    )  # fmt: skip
    reader = Reader(report_page(bare))
    assert "No warnings." in reader.text
    assert "Laguerre" in reader.text
    assert "nan" not in re.sub(r"domi?nan|nominal|resonan", "", reader.text)
    assert "acc2 in roving" in reader.text
    assert "acc3 in roving" not in reader.text


def test_a_missing_folder_is_told(found, tmp_path):
    with pytest.raises(InputError, match="no folder"):
        write_report(found, tmp_path / "missing" / "report.html")


def test_a_missing_package_is_told():
    with pytest.raises(InputError, match=r"needs no_such_package.*\.\[plot\]"):
        check_installed("jinja2", "no_such_package")


def test_many_sensors_show_the_worst(found):
    """Forty sensors: tables and figures keep to the worst."""
    count, (record,) = 40, found.records
    names = tuple(f"s{i}" for i in range(count))
    bodies = tuple(f"b{i}" for i in range(count))
    nominal = lumped_model(
        bodies,
        np.ones(count),
        sensors=[Sensor(s, b, "velocity") for s, b in zip(names, bodies, strict=True)],
        inputs=[Input("force", "b0")],
        name="plate",
    )
    y = np.tile(np.asarray(record.y)[:, :1], (1, count))
    many = dataclasses.replace(
        without_matrices(found), nominal=nominal, outputs=names, frequency_fit=(),
        records=(Record(record.u, y, record.dt, inputs=("force",), outputs=names),),
        predictions=(jnp.asarray(0.9 * y),), train_nrmse=jnp.linspace(0.01, 0.4, count),
        nominal_nrmse=jnp.ones(count), residuals=(),
        noise_floor=jnp.full(count, 0.01), shape_std=jnp.full((count, 6), 0.01 + 0.01j),
        modal=dataclasses.replace(
            without_matrices(found).modal,
            shapes=jnp.ones((count, 6), complex),
            feedthrough=jnp.zeros((count, 1)),
        ),
        time_response=jnp.ones((50, count, 1)),
        response=ImpulseResponse(np.ones((50, count, 1)), record.dt),
    )  # fmt: skip
    text = Reader(report_page(many)).text
    assert "The 20 worst of 40 sensors" in text
    assert "6 of 40 are shown, the worst fitting" in text
    assert "and 28 more" in text


def test_the_frame_serves_other_reports(found):
    """Blocks of every kind in a page of its own; sections without blocks are left out."""
    table = Table(("", "value"), (("a<b", Cell("1", "small", -0.5, "warning")),), "Table", "note")
    blocks = (
        Text("words & words"),
        Notice("Careful", ("first", "second")),
        Cards((Card("name", "12", "remark"),)),
        table,
        Gallery((picture(pole_figure(found), 'caption "quoted"'),), "look here"),
        Links((Link("paper", "https://doi.org/10.1"), Link("book"))),
    )
    reader = Reader(page("A & B", "of <x>", (Section("One thing", blocks), Section("Empty", ())), "end"))
    for text in (
        "A & B",
        "of <x>",
        "a<b",
        "words & words",
        "second",
        "remark",
        'caption "quoted"',
        "book",
        "end",
    ):
        assert text in reader.text
    assert "Empty" not in reader.text
    assert "one-thing" in reader.ids
