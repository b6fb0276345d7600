"""The shape of a study file. Import it inside functions: pydantic is slow to load."""

from typing import Annotated, Any, Literal

from pydantic import Field

from jaxsid.files.schema import Strict, Text


class StudyFile(Strict):
    """The factors are checked one by one after the types are right."""

    name: Text = "study"
    seed: Annotated[int, Field(ge=0)] = 0
    realizations: Annotated[int, Field(ge=1)] = 1000
    chunk: Annotated[int, Field(ge=1)] = 256
    sampling: Literal["grid", "random"] = "grid"
    cases: Annotated[int, Field(ge=1, le=100_000)] | None = None
    factors: dict[str, Any]
