"""The shape of the TOML files: which keys there are and of what type.

Import it inside functions: pydantic is slow to load.
"""

from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field

Number = Annotated[float, Field(allow_inf_nan=False)]
Text = Annotated[str, Field(min_length=1)]


class Strict(BaseModel):
    """Numbers are numbers and text is text; a key that is not known is a mistake."""

    model_config = ConfigDict(extra="forbid", strict=True)


class ConnectionTable(Strict):
    name: Text
    between: list[str]
    stiffness: Number = 0.0
    damping: Number = 0.0


class InputTable(Strict):
    name: Text
    body: Text
    hold: Text = "zero"


class SensorTable(Strict):
    name: Text
    body: Text
    kind: Text


class ToleranceTable(Strict):
    mass: Number = 0.005
    stiffness: Number = 0.005
    damping: Number = 0.05


class MatricesTable(Strict):
    mass: list[list[Number]]
    damping: list[list[Number]]
    stiffness: list[list[Number]]


class EffectTable(Strict):
    """An effect's place is one of four keys; all others are parameters, one number or one for each record."""

    model_config = ConfigDict(extra="allow", strict=True)
    __pydantic_extra__: dict[str, Any]
    kind: Text
    between: list[str] | None = None
    body: Text | None = None
    sensor: Text | None = None
    input: Text | None = None


class ModelFile(Strict):
    """A model in elements or in matrices; which of the two is checked after the types are right."""

    name: Text = "model"
    bodies: Any
    connections: list[ConnectionTable] = []
    matrices: MatricesTable | None = None
    inputs: list[InputTable] = []
    sensors: list[SensorTable] = []
    tolerance: ToleranceTable = ToleranceTable()
    effects: list[EffectTable] = []


class MassesTable(Strict):
    bodies: dict[Text, Number]


class BodyNames(Strict):
    bodies: list[Text]


class RecordTable(Strict):
    file: Text
    columns: dict[str, str | int] = {}
    scale: dict[str, Number] = {}
    rate: Annotated[Number, Field(gt=0)] | None = None
    time_unit: Literal["s", "ms", "us"] | None = None


class RecordsFile(Strict):
    records: list[RecordTable]


MODEL_TABLES = {
    "connections": ConnectionTable,
    "inputs": InputTable,
    "sensors": SensorTable,
    "tolerance": ToleranceTable,
    "matrices": MatricesTable,
    "effects": EffectTable,
}
RECORD_TABLES = {"records": RecordTable}
