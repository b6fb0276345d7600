"""A figure as SVG to stand inside a page: text as text, colours that follow the page, names of its own."""

import hashlib
import html
import io
import re
from typing import Any

import matplotlib
from matplotlib.figure import Figure

from jaxsid.report.style import CSS_COLOURS

SETTINGS: dict[Any, Any] = {"svg.hashsalt": "jaxsid", "svg.fonttype": "none", "path.simplify_threshold": 0.3}
DPI = 150  # of what is drawn as an image
NOTHING: Any = {"Date": None, "Creator": None}
REFERENCES = re.compile(r'(?:xlink:href="#|url\(#)([^")]+)')
PATH = re.compile(r'\sd="([^"]*)"')
LONG = re.compile(r"(\d\.\d\d)\d+")
IDENTITY = re.compile(r'\sid="([^"]+)"')


def inline_svg(figure: Figure, alternative: str) -> str:
    """An <svg> element that scales with its place; `alternative` is read to those who cannot see it."""
    text = _drawn(figure, "none")
    text = _own_names(text, hashlib.sha256(text.encode()).hexdigest()[:8])
    for colour, variable in CSS_COLOURS.items():
        text = text.replace(colour, f"var({variable})")
    return _opened(text, alternative)


def file_svg(figure: Figure) -> str:
    """An SVG file of its own, on white."""
    return _own_names(_drawn(figure, "white"), "p") + "\n"


def _drawn(figure: Figure, ground: str) -> str:
    stream = io.StringIO()
    with matplotlib.rc_context(SETTINGS):
        figure.savefig(stream, format="svg", facecolor=ground, dpi=DPI, metadata=NOTHING)
    return _short(stream.getvalue())


def _short(text: str) -> str:
    """Without prologue, comments and metadata, paths to a hundredth of a point."""
    text = text[text.index("<svg") :]
    text = re.sub(r"<metadata>.*?</metadata>|<!--.*?-->", "", text, flags=re.DOTALL)
    text = PATH.sub(_short_path, text)
    return re.sub(r">\s+<", "><", text)


def _short_path(match: re.Match[str]) -> str:
    path = LONG.sub(r"\1", " ".join(match[1].split()))
    return f' d="{path}"'


def _own_names(text: str, prefix: str) -> str:
    """Names that are referred to become unique in the page, the others go."""
    used = set(REFERENCES.findall(text))
    text = IDENTITY.sub(lambda m: f' id="{prefix}{m[1]}"' if m[1] in used else "", text)
    return text.replace('xlink:href="#', f'href="#{prefix}').replace("url(#", f"url(#{prefix}")


def _opened(text: str, alternative: str) -> str:
    """The opening tag: its box, no fixed size, what it shows."""
    box = re.search(r'viewBox="[^"]+"', text)
    assert box is not None
    label = html.escape(alternative, quote=True)
    return f'<svg {box[0]} role="img" aria-label="{label}">' + text[text.index(">") + 1 :]
