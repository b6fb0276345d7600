"""TOML in and out: the parsed file, a pydantic schema's verdict in plain words, and a compact layout."""

import tomllib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from jaxsid.checks import InputError, bad_input
from jaxsid.files.naming import listing, require_file, suggestion

if TYPE_CHECKING:
    from pydantic import BaseModel

    Schema = TypeVar("Schema", bound=BaseModel)


def load_toml(path: Path) -> dict[str, Any]:
    """The parsed file; InputError with the line where it is not TOML."""
    require_file(path)
    try:
        return tomllib.loads(path.read_bytes().decode("utf-8-sig"))
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: is not UTF-8 text ({error}). Is it a TOML file?") from None
    except tomllib.TOMLDecodeError as error:
        raise InputError(f"{path}: is not valid TOML: {error}.") from None
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}.") from None


def checked(
    schema: "type[Schema]", data: dict[str, Any], path: Path, tables: Mapping[str, "type[BaseModel]"]
) -> "Schema":
    """The data as the schema's record; InputError naming file, table and key of every mistake.

    `tables` gives the schema of the entries of each array of tables, for the names that are known there.
    """
    from pydantic import ValidationError

    try:
        return schema.model_validate(data)
    except ValidationError as error:
        lines = [problem(dict(entry), data, schema, tables) for entry in error.errors()]
        text = f" {lines[0]}" if len(lines) == 1 else "".join(f"\n  - {line}" for line in lines)
        bad_input(f"{path}:{text}")


def problem(
    entry: dict[str, Any],
    data: dict[str, Any],
    schema: "type[BaseModel]",
    tables: Mapping[str, "type[BaseModel]"],
) -> str:
    """One mistake that pydantic found, in words."""
    location = [
        part for part in entry["loc"] if not (isinstance(part, str) and part in ("str", "int", "float"))
    ]
    place, key = table_and_key(location, data)
    if entry["type"] == "missing":
        return f"{place}key '{key}' is missing."
    if entry["type"] == "extra_forbidden":
        known = list((tables[str(location[0])] if len(location) > 1 else schema).model_fields)
        return f"{place}key '{key}' is unknown.{suggestion(key, known)} Known here: {listing(known)}."
    if entry["type"] == "list_type" and key in tables:
        return (
            f"{place}key '{key}': there may be several, so write [[{key}]], in double brackets, above each."
        )
    return f"{place}key '{key}': {entry['msg'].lower()}, but found {entry['input']!r}."


def table_and_key(location: Sequence[str | int], data: dict[str, Any]) -> tuple[str, str]:
    """Where a key stands, such as "[[connections]] number 2 ('gearbox'), ", and the key."""
    if len(location) == 2 and isinstance(location[1], int):
        return f"{location[0]}: entry {location[1] + 1}, ", str(location[0])
    if len(location) > 1 and isinstance(location[1], int):
        entry = data[str(location[0])][location[1]]
        name = entry.get("name", entry.get("file")) if isinstance(entry, dict) else None
        label = f" ('{name}')" if name is not None else ""
        return f"[[{location[0]}]] number {location[1] + 1}{label}, ", ".".join(map(str, location[2:]))
    if len(location) > 1:
        return f"[{location[0]}], ", ".".join(map(str, location[1:]))
    return "", str(location[0])


def value_text(value: Any) -> str:
    """A TOML value on one line."""
    import tomli_w

    if isinstance(value, (list, tuple)):
        return "[" + ", ".join(value_text(item) for item in value) + "]"
    return tomli_w.dumps({"x": value}).removeprefix("x = ").rstrip("\n")


def table_text(table: Mapping[str, Any], heading: str = "") -> str:
    """A table of values, one a line, below its heading; a list of lists gets a row a line."""
    lines = [heading] if heading else []
    for key, value in table.items():
        nested = isinstance(value, (list, tuple)) and value and isinstance(value[0], (list, tuple))
        text = (
            "[\n" + "".join(f"  {value_text(row)},\n" for row in value) + "]" if nested else value_text(value)
        )
        lines.append(f"{key_text(key)} = {text}")
    return "\n".join(lines) + "\n"


def key_text(key: str) -> str:
    """A TOML key, in quotes where it needs them."""
    import tomli_w

    return tomli_w.dumps({key: 0}).removesuffix(" = 0\n")
