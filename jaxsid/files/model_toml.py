"""The model file: a LumpedModel from TOML and back."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Array

from jaxsid.checks import InputError, bad_input, require
from jaxsid.files.atomic import write_atomically
from jaxsid.files.toml_file import checked, load_toml, table_text
from jaxsid.mechanics.lumped import (
    Connection,
    Effect,
    Input,
    LumpedModel,
    Matrices,
    Sensor,
    Tolerance,
    lumped_model,
)
from jaxsid.records import floating

if TYPE_CHECKING:
    from jaxsid.files.schema import EffectTable, ModelFile

PLACES = ("between", "body", "sensor", "input")


def read_model(path: Path | str) -> LumpedModel:
    """The lumped model of a TOML file, in elements or in matrices, with its tolerance and effects.

    Masses in kg (kg m^2), stiffness N/m (N m), damping N s/m (N m s).

    Args:
        path: of the file.

    Raises:
        InputError: naming file, table and key, where the file is missing, is not TOML, has unknown keys
            or wrong types, or describes no possible mechanical system.
    """
    from jaxsid.files.schema import MODEL_TABLES, ModelFile

    path = Path(path)
    data = load_toml(path)
    file = checked(ModelFile, data, path, MODEL_TABLES)
    effects = [effect_of(table, number, path) for number, table in enumerate(file.effects, 1)]
    names, elements = matrix_form(file, data, path) if file.matrices else element_form(file, data, path)
    try:
        return lumped_model(
            names,
            **elements,
            inputs=[Input(i.name, i.body, i.hold) for i in file.inputs],
            sensors=[Sensor(s.name, s.body, s.kind) for s in file.sensors],
            tolerance=Tolerance(**file.tolerance.model_dump()),
            effects=effects,
            name=file.name,
        )
    except InputError as error:
        raise InputError(f"{path}: {error}") from None


def element_form(file: "ModelFile", data: dict[str, Any], path: Path) -> tuple[Sequence[str], dict[str, Any]]:
    """Body names and the arguments of a model in elements."""
    from jaxsid.files.schema import MassesTable

    require(
        isinstance(data["bodies"], dict),
        f"{path}: key 'bodies': give a table [bodies] of names and masses, or a list of names "
        "and a table [matrices].",
    )
    masses = checked(MassesTable, {"bodies": data["bodies"]}, path, {}).bodies
    return list(masses), {
        "mass": list(masses.values()),
        "stiffness": [c.stiffness for c in file.connections],
        "damping": [c.damping for c in file.connections],
        "connections": [
            Connection(c.name, ends(c.between, f"{path}: [[connections]] number {number} ('{c.name}')"))
            for number, c in enumerate(file.connections, 1)
        ],
    }


def matrix_form(file: "ModelFile", data: dict[str, Any], path: Path) -> tuple[Sequence[str], dict[str, Any]]:
    """Body names and the arguments of a model in matrices."""
    from jaxsid.files.schema import BodyNames

    require(
        isinstance(data["bodies"], list),
        f"{path}: key 'bodies': with a table [matrices] it is a list of names, "
        'such as bodies = ["b1", "b2"].',
    )
    require(not file.connections, f"{path}: give either [[connections]] or [matrices], not both.")
    names = checked(BodyNames, {"bodies": data["bodies"]}, path, {}).bodies
    matrices = {
        key: floating(matrix(rows, len(names), f"{path}: [matrices], key '{key}'"))
        for key, rows in file.matrices.model_dump().items()  # type: ignore[union-attr]
    }
    return names, {"matrices": Matrices(matrices["mass"], matrices["damping"], matrices["stiffness"])}


def matrix(rows: list[list[float]], size: int, where: str) -> np.ndarray:
    """The rows as a square array."""
    lengths = [len(row) for row in rows]
    require(
        lengths == [size] * size,
        f"{where}: {size} bodies need {size} rows of {size} numbers, found rows of {lengths}.",
    )
    return np.array(rows, dtype=float)


def ends(between: Sequence[str], where: str) -> tuple[str, str]:
    """The two ends of a connection."""
    require(
        len(between) == 2,
        f"{where}, key 'between': names two bodies, or a body and \"ground\", found {list(between)}.",
    )
    return between[0], between[1]


def effect_of(table: "EffectTable", number: int, path: Path) -> Effect:
    """The effect of an [[effects]] table."""
    where = f"{path}: [[effects]] number {number} ('{table.kind}')"
    given = [place for place in PLACES if getattr(table, place) is not None]
    require(
        len(given) == 1,
        f"{where}: needs one place, either {', '.join(PLACES[:-1])} or {PLACES[-1]}; "
        f"found {given or 'none'}.",
    )
    value = getattr(table, given[0])
    place = ends(value, where) if given[0] == "between" else value
    extra = table.model_extra or {}
    parameters = {key: floating(parameter(item, f"{where}, key '{key}'")) for key, item in extra.items()}
    return Effect(kind=table.kind, place=((given[0], place),), parameters=parameters)


def parameter(value: object, where: str) -> np.ndarray:
    """A number, or one number for each record."""
    items = value if isinstance(value, list) else [value]
    good = all(isinstance(x, (int, float)) and not isinstance(x, bool) and np.isfinite(x) for x in items)
    if not good or not items:
        bad_input(f"{where}: must be a number, or a list of numbers, one for each record; found {value!r}.")
    return np.asarray(value, dtype=float)


def write_model(model: LumpedModel, path: Path | str, header: str = "Lumped mechanical model.") -> None:
    """Write the model as TOML that `read_model` turns into an equal model; the header becomes comment lines.

    Args:
        model: to write.
        path: of the file.
        header: what the file is, in words.

    Raises InputError where the folder is missing or cannot be written to.
    """
    text = model_text(model, header)
    write_atomically(path, lambda stream: stream.write(text))


def model_text(model: LumpedModel, header: str) -> str:
    """The TOML text of a model."""
    comment = "".join(f"# {line}".rstrip() + "\n" for line in header.splitlines())
    top: dict[str, Any] = {"name": model.name}
    if model.matrices is not None:
        top["bodies"] = list(model.bodies)
    blocks = [comment + table_text(top), *mechanics_blocks(model)]
    blocks += [table_text(i._asdict(), "[[inputs]]") for i in model.inputs]
    blocks += [table_text(s._asdict(), "[[sensors]]") for s in model.sensors]
    blocks.append(table_text({key: float(x) for key, x in model.tolerance._asdict().items()}, "[tolerance]"))
    blocks += [table_text(effect_table(effect), "[[effects]]") for effect in model.effects]
    return "\n".join(blocks)


def mechanics_blocks(model: LumpedModel) -> list[str]:
    """Bodies and connections, or matrices."""
    if model.matrices is not None:
        names = ("mass", "damping", "stiffness")
        return [table_text({name: numbers(getattr(model.matrices, name)) for name in names}, "[matrices]")]
    masses = dict(zip(model.bodies, numbers(model.mass), strict=True))
    rows = zip(model.connections, numbers(model.stiffness), numbers(model.damping), strict=True)
    return [table_text(masses, "[bodies]")] + [
        table_text({"name": c.name, "between": c.between, "stiffness": k, "damping": d}, "[[connections]]")
        for c, k, d in rows
    ]


def effect_table(effect: Effect) -> dict[str, Any]:
    """Kind, place and parameters of an effect."""
    parameters = {key: numbers(value) for key, value in effect.parameters.items()}
    return {"kind": effect.kind, **dict(effect.place), **parameters}


def numbers(values: Array) -> Any:
    """Plain numbers, with the fewest digits that give back the same value in the array's own precision."""
    array = np.asarray(values)
    return np.asarray([float(str(x)) for x in array.ravel()]).reshape(array.shape).tolist()
