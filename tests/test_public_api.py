"""Every public name exists and says what each of its arguments is."""

import inspect
import re

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
