"""Every public name exists and says what each of its arguments is."""

import inspect
import re
from pathlib import Path

import pytest

import jaxsid

NAMES = tuple(getattr(jaxsid, "__all__", ()))


def arguments(thing: object) -> list[str]:
    """Names of what a function or a record takes; an exception takes its message."""
    if not callable(thing) or (inspect.isclass(thing) and issubclass(thing, BaseException)):
        return []
    parameters = inspect.signature(thing).parameters.values()
    return [
        p.name for p in parameters if p.name != "self" and p.kind not in (p.VAR_POSITIONAL, p.VAR_KEYWORD)
    ]


def test_there_are_public_names_each_once():
    assert NAMES
    assert len(set(NAMES)) == len(NAMES)


@pytest.mark.parametrize("name", NAMES)
def test_documented(name):
    thing = getattr(jaxsid, name)
    doc = inspect.getdoc(thing) or ""
    assert doc, f"{name} has no docstring"
    missing = [argument for argument in arguments(thing) if not re.search(rf"\b{re.escape(argument)}\b", doc)]
    assert not missing, f"the docstring of {name} does not mention {missing}"


def test_the_stages_of_the_readme_run_as_printed(capsys: pytest.CaptureFixture[str]):
    readme = (Path(__file__).parents[1] / "README.md").read_text()
    (stages,) = (block for block in re.findall(r"```python\n(.*?)```", readme, re.DOTALL) if "era(" in block)
    exec(stages, names := {})
    assert names["so"].mass.shape == (3, 3)
    assert abs(float(names["so"].stiffness[2, 2]) - 22) < 1e-3
    assert "1.3776" in capsys.readouterr().out
