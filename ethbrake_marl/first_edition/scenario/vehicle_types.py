"""Vehicle types: the quantities of a car, a van or a truck, and the types that are possible at each place of a line.

The type of a vehicle is drawn first, then its quantities are drawn from the declarations of this type. All quantities
``{with_load: [empty, full]}`` of a vehicle depend on the same load: a full truck is heavy *and* brakes weakly.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from operator import not_
from typing import Annotated, Any

import numpy as np
from pydantic import (
    AfterValidator,
    Discriminator,
    Field,
    GetJsonSchemaHandler,
    Tag,
    ValidationInfo,
    field_validator,
    model_validator,
)
from pydantic.json_schema import JsonSchemaValue
from pydantic_core import CoreSchema

from ethbrake_marl.files.model import NAME_PATTERN, UNSHOWN, FileModel, require
from ethbrake_marl.first_edition.game.features import ListedFeatures
from ethbrake_marl.first_edition.game.objectives import OBJECTIVES
from ethbrake_marl.first_edition.physics.state import Floats, Ints
from ethbrake_marl.first_edition.scenario.channel import Equipage
from ethbrake_marl.first_edition.scenario.distributions import (
    LEAVE_OUT,
    Number,
    Numbers,
    Quantity,
    TableColumn,
    Uniform,
    WithLoad,
    support,
)
from ethbrake_marl.first_edition.scenario.fields import MEANING, QUANTITY, RECORDING

ANY = "any"  # entry of ``types`` that allows every type, in proportion to its weight

TypeName = Annotated[str, Field(pattern=NAME_PATTERN)]

ListedByVehicle = Annotated[
    dict[Annotated[str, Field(pattern=r"^vehicle_[1-9][0-9]?$")], ListedFeatures],
    Field(min_length=1, json_schema_extra={"additionalProperties": False}),
]

Weight = Annotated[float, Field(gt=0.0, le=1e9, allow_inf_nan=False)]


def _loaded(value: object) -> str:
    return "#with_load" if isinstance(value, WithLoad) or (isinstance(value, dict) and "with_load" in value) else "#one"


TypeQuantity = Annotated[
    Annotated[Quantity, Tag("#one")] | Annotated[WithLoad, Tag("#with_load")], Discriminator(_loaded)
]


class VehicleType(FileModel):
    """A vehicle type: its weight in the random draw, and its quantities.

    If a type does not declare a quantity, the type has the scenario's declaration of this quantity outside
    ``vehicle_types``.
    """

    weight: Weight = Field(default=1.0, description="how likely this type is, relative to the other types")
    load: Quantity = Field(
        default_factory=lambda: Uniform(uniform=(0.0, 1.0)), description="load, as a fraction of the full load, 0 to 1"
    )
    braking_capacity_mps2: TypeQuantity | None = Field(default=None, description=MEANING["braking_capacity_mps2"])
    driving_capacity_mps2: TypeQuantity | None = Field(default=None, description=MEANING["driving_capacity_mps2"])
    mass_t: TypeQuantity | None = Field(default=None, description=MEANING["mass_t"])
    latency_s: TypeQuantity | None = Field(default=None, description=MEANING["latency_s"])
    speed_limit_mps: TypeQuantity | None = Field(default=None, description=MEANING["speed_limit_mps"])
    brake_rate_mps3: TypeQuantity | None = Field(default=None, exclude_if=not_, description=MEANING["brake_rate_mps3"])
    release_rate_mps3: TypeQuantity | None = Field(
        default=None, exclude_if=not_, description=MEANING["release_rate_mps3"]
    )
    v2x: Equipage | None = Field(
        default=None, exclude_if=not_, description="V2X equipment of this type; by default sending and receiving"
    )

    @field_validator(*QUANTITY.of_a_type)
    @classmethod
    def _in_range(cls, value: Any, info: ValidationInfo) -> Any:
        require(value is not None, (), value, LEAVE_OUT)
        rule = QUANTITY.declared[str(info.field_name)]
        require(rule.allows(*support(value)), (), value, f"must be {rule.interval}")
        return value

    @field_validator("load")
    @classmethod
    def _share(cls, value: Any) -> Any:
        low, high = support(value)
        require(low >= 0.0 and high <= 1.0, (), value, "a load must be in [0, 1]: 0 is empty, 1 is full")
        return value


def _check_type_names(kinds: dict[str, VehicleType]) -> dict[str, VehicleType]:
    require(ANY not in kinds, (ANY,), UNSHOWN, f"{ANY} means every type, so it cannot be a name; use another name")
    return kinds


VehicleTypes = Annotated[dict[TypeName, VehicleType], Field(min_length=1), AfterValidator(_check_type_names)]

TypesHere = str | dict[str, Weight]  # possible types of one vehicle: a type, ``any``, or a weight per type


def _one_or_each(value: object) -> str:
    return "#each" if isinstance(value, list | tuple) else "#one"


Types = Annotated[
    Annotated[TypesHere, Tag("#one")]
    | Annotated[tuple[TypesHere, ...], Field(strict=False, min_length=1), Tag("#each")],
    Discriminator(_one_or_each),
]


class TypesOfLine:
    """The possible vehicle types at each place of a line, and their weights.

    ``kinds`` maps the name of each vehicle type to its declaration; the index of a type is its position in this
    mapping, from 0. ``types`` has the possible types at each place of the line, with one entry per place or one entry
    for all places; None: every type is possible at every place, in proportion to its weight.
    """

    def __init__(self, kinds: Mapping[str, VehicleType], types: Types | None, vehicles: int) -> None:
        self.names = tuple(kinds)
        self.kinds = tuple(kinds.values())
        of_vehicle: Sequence[TypesHere]
        of_vehicle = types if isinstance(types, tuple) else (ANY if types is None else types,) * vehicles
        self.weights = np.array([[_weight(kinds, name, here) for name in kinds] for here in of_vehicle])

    def possible(self, vehicle: int) -> list[int]:
        """Return the indices of the possible types of ``vehicle`` (index from 0)."""
        return np.flatnonzero(self.weights[vehicle] > 0.0).tolist()

    def draw(self, u: Floats) -> tuple[Ints, Floats]:
        """Return the type (index) and the load (0 empty to 1 full) of every vehicle, both [n, N].

        ``u`` has uniform numbers in [0, 1), [n, N, 2 or more]; ``u[..., 0]`` draws the type, ``u[..., 1]`` the load.
        """
        n, vehicles = u.shape[:2]
        types, load = np.zeros((n, vehicles), np.int64), np.zeros((n, vehicles))
        for i in range(vehicles):
            cumulative = np.cumsum(self.weights[i])
            types[:, i] = np.searchsorted(cumulative / cumulative[-1], u[:, i, 0], side="right")
            for kind in self.possible(i):
                rows, shape = types[:, i] == kind, self.kinds[kind].load
                load[rows, i] = shape if isinstance(shape, float) else shape.value(u[rows, i, 1])
        return types, load


def _weight(kinds: Mapping[str, VehicleType], name: str, here: TypesHere) -> float:
    if isinstance(here, str):
        return kinds[name].weight if here == ANY else float(here == name)
    return here.get(name, 0.0)


LEFT_OUT: Any = object()  # default value that marks a missing key; a check then accepts or rejects it

PerVehicle = Annotated[
    Annotated[Quantity, Tag("#one")] | Annotated[tuple[Quantity, ...], Field(strict=False, min_length=1), Tag("#each")],
    Discriminator(_one_or_each),
]


class _ObjectiveSchema:
    """Pydantic annotation of an objective's name: the field's JSON schema lists all objectives registered so far."""

    @classmethod
    def __get_pydantic_json_schema__(cls, core: CoreSchema, handler: GetJsonSchemaHandler) -> JsonSchemaValue:
        kinds = OBJECTIVES.usable()
        plain = [name for name, kind in kinds.items() if ":" not in kind.form]
        with_argument = "|".join(name for name, kind in kinds.items() if ":" in kind.form)
        return {"type": "string", "anyOf": [{"enum": plain}, {"pattern": f"^({with_argument}):"}]}


ObjectiveName = Annotated[str, _ObjectiveSchema]

MOST_NUMBERS = 100_000  # largest number of values in a table; every copy of the scenario contains the table

MOST_CHARACTERS = 200  # longest name of a recording in a table

_NAME = f"recording must be a text of 1 to {MOST_CHARACTERS} printable characters, such as 'drive_1.csv: 2-3-4'"

Column = Annotated[str, Field(pattern=r"^[a-z_]+(_[0-9]+)?[a-z0-9_]*$", max_length=64)]

Cell = Annotated[
    Annotated[Number, Tag("#number")] | Annotated[str, Tag("#text")],
    Discriminator(lambda value: "#text" if isinstance(value, str) else "#number"),
]

Row = Annotated[tuple[Cell, ...], Field(strict=False, min_length=1)]


class Table(FileModel):
    """A table of measured values: every world takes its values from one row, drawn in proportion to the row's weight.

    A scenario file may name a CSV file that contains the rows of the table. Rows with the same text in the column
    ``recording`` come from the same vehicles in the same recording, so they are not independent of each other.
    """

    file: str = Field(
        default="", exclude_if=not_, description="path of a CSV file with a header, relative to the scenario's folder"
    )
    columns: Annotated[tuple[Column, ...], Field(strict=False, min_length=1)] = Field(
        description="names of the columns, or of the columns of the file that are used: gap_1_m, speed_2_mps, ...;"
        " the column recording has texts that name the recording and the vehicles of a row"
    )
    weights: str | Annotated[Numbers, Field()] | None = Field(
        default=None,
        exclude_if=not_,
        description="how likely each row is: a list with one number per row, or the name of a column of the file",
    )
    rows: Annotated[tuple[Row, ...], Field(strict=False, min_length=1)] | None = Field(
        default=None, description="rows with one number per column (a text for recording); left out if file is given"
    )

    @model_validator(mode="after")
    def _complete(self) -> Table:
        read = "must be given as lists here; only load_scenario reads the rows from a file"
        require(
            not (self.file and self.rows), ("file",), self.file, "cannot be combined with rows; leave one of them out"
        )
        require(self.rows is not None and not isinstance(self.weights, str), ("rows",), UNSHOWN, read)
        rows = self.rows or ()
        for k, row in enumerate(rows):
            right = f"has {len(row)} values; must have one for each of the {len(self.columns)} columns"
            require(len(row) == len(self.columns), ("rows", k), UNSHOWN, right)
            for c, (name, cell) in enumerate(zip(self.columns, row, strict=True)):
                good = _names(cell) if name == RECORDING else not isinstance(cell, str)
                require(good, ("rows", k, c), cell, _NAME if name == RECORDING else f"{name} must be a number")
        numbers = len(rows) * sum(name != RECORDING for name in self.columns)
        most = f"has {numbers:,} numbers; must have at most {MOST_NUMBERS:,}"
        require(numbers <= MOST_NUMBERS, ("rows",), UNSHOWN, most)
        twice = [name for name in self.columns if self.columns.count(name) > 1]
        require(not twice, ("columns",), twice[:1], "must not list a column twice")
        require(self.columns != (RECORDING,), ("columns",), self.columns, "must also have a column of numbers")
        if isinstance(self.weights, tuple):
            fits = f"must be {len(rows)} numbers, one per row, all above 0 and with a finite sum"
            good = len(self.weights) == len(rows) and min(self.weights) > 0.0 and math.isfinite(sum(self.weights))
            require(good, ("weights",), UNSHOWN, fits)
        return self

    def column_values(self) -> dict[str, TableColumn]:
        """Return the table's columns by name, including ``recording``; each column also has the weights of the rows."""
        rows = self.rows or ()
        weights = self.weights if isinstance(self.weights, tuple) else (1.0,) * len(rows)
        cumulative = np.cumsum(np.asarray(weights))
        return {
            name: TableColumn(name, np.array(column), cumulative / cumulative[-1])
            for name, column in zip(self.columns, zip(*rows, strict=True), strict=True)
        }


def _names(cell: float | str) -> bool:
    """Return whether a cell of a table can name a recording: a short printable text without blanks around it."""
    return isinstance(cell, str) and 0 < len(cell) <= MOST_CHARACTERS and cell.isprintable() and cell == cell.strip()
