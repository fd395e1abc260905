"""``Scenario``: a validated, immutable description of how worlds are drawn."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from enum import Enum
from functools import cached_property
from operator import not_
from pathlib import PurePath
from typing import Annotated, Any, Literal, Self

import numpy as np
from pydantic import (
    AfterValidator,
    BaseModel,
    Discriminator,
    Field,
    Tag,
    ValidationError,
    ValidationInfo,
    WithJsonSchema,
    field_validator,
    model_validator,
)

from ethbrake_marl.episode.features import listed_features
from ethbrake_marl.episode.objectives import objectives_of
from ethbrake_marl.episode.observe import View
from ethbrake_marl.episode.state import State
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.files.model import NAME_PATTERN, UNSHOWN, explain
from ethbrake_marl.files.yaml import Document
from ethbrake_marl.motion.layout import Bools, Floats, Ints
from ethbrake_marl.worlds.channel import V2X
from ethbrake_marl.worlds.checks import ScenarioWording, check_scenario
from ethbrake_marl.worlds.counters import Purpose, world_numbers
from ethbrake_marl.worlds.derived import world_values
from ethbrake_marl.worlds.mixture import DESCRIPTIVE_KEYS, changed_content, with_members
from ethbrake_marl.worlds.quantities import OF_A_TYPE, OPTIONAL, QUANTITIES, USUAL, check_length, table_columns
from ethbrake_marl.worlds.quantity import PerVehicle, Quantity, ScenarioPart, Weight, support
from ethbrake_marl.worlds.roles import LEARNER, Roles, check_role, check_vehicle, names_of
from ethbrake_marl.worlds.sampling import DrawnWorlds, WorldPool, draw_worlds
from ethbrake_marl.worlds.table import Table, TableColumn
from ethbrake_marl.worlds.vehicle_types import Types, TypesOfLine, VehicleTypes


def _check_features(names: tuple[str, ...]) -> tuple[str, ...]:
    listed_features(names)
    return names


Features = Annotated[tuple[str, ...], Field(strict=False), AfterValidator(_check_features)]
Observation = Annotated[
    Annotated[Features, Tag("#all")] | Annotated[dict[str, Features], Field(min_length=1), Tag("#each")],
    Discriminator(lambda value: "#each" if isinstance(value, dict) else "#all"),
]
NAME_OR_CONTENT = {"anyOf": [{"type": "object", "additionalProperties": True}, {"type": "string"}]}


class Member(ScenarioPart):
    """One scenario of a mixture. In a file ``scenario`` may be a name or path; loading replaces it by the content."""

    scenario: Annotated[Scenario, WithJsonSchema(NAME_OR_CONTENT)] = Field(
        description="name of a scenario, path of its file, or the content of such a file"
    )
    weight: Weight = Field(
        default=1.0, description="how likely a world is drawn from this scenario, relative to the other scenarios"
    )


def _quantity(key: str, default: Any = None, **more: Any) -> Any:
    return Field(default=default, description=QUANTITIES[key].meaning, **more)


class Scenario(ScenarioPart):
    """A line of vehicles, the distribution of each quantity, and the vehicles that learn.

    A quantity is a number, ``{uniform: [low, high]}``, ``{loguniform: [low, high]}``,
    ``{normal: {mean, sd, low, high}}``, ``{lognormal: {median, sigma, low, high}}`` or ``{choice: [...]}``. One entry
    is for all vehicles, each of which draws its own value; a list has one entry per vehicle, or per pair for gaps.
    ``Scenario(...)``, ``load_scenario`` and ``replace`` raise ``InvalidInput`` for an invalid value.

    >>> import ethbrake_marl as eb
    >>> scenario = eb.load_scenario("paper-random").replace(mass_t=[4.5, 5.5, 40.0])
    >>> scenario.bounds("mass_t")
    ((4.5, 4.5), (5.5, 5.5), (40.0, 40.0))

    """

    name: str = Field(pattern=NAME_PATTERN, description="name of the scenario: the file's name without .yaml")
    title: str = Field(default="", description="one-line title for lists and figures")
    description: str = Field(default="", description="what the scenario is for")
    source: str = Field(default="", description="where the values come from")
    based_on: Annotated[None, WithJsonSchema({"type": "string"})] = Field(
        default=None,
        exclude=True,
        description="scenario whose values this one has, except those of the keys in this file: its name, or the path"
        " of its file; null as a value takes a key away",
    )
    vehicles: int = Field(default=3, ge=2, le=64, description="number of vehicles N, with vehicle_1 in front")
    vehicle_types: VehicleTypes | None = Field(
        default=None,
        exclude_if=not_,
        description="vehicle types by name, such as car and truck: how likely each type is, and its quantities",
    )
    types: Types | None = Field(
        default=None,
        exclude_if=not_,
        description="possible types of each vehicle: a type's name, any, or a mapping from types to weights; give one"
        " entry for all vehicles or a list with one entry per vehicle",
    )
    mixture: Annotated[tuple[Member, ...], Field(strict=False, min_length=1)] | None = Field(
        default=None, exclude_if=not_, description="scenarios with weights; each world is drawn from one of them"
    )
    table: Table | None = Field(
        default=None,
        exclude_if=not_,
        description="table of measured values: every world takes one row; quantities without a column are drawn",
    )
    time_step_s: float = Field(default=0.1, ge=1e-3, allow_inf_nan=False, description="time between two decisions")
    horizon_s: float = Field(
        default=8.0, gt=0.0, le=3600.0, allow_inf_nan=False, description="time at which an episode is truncated"
    )
    gaps_m: PerVehicle | None = _quantity("gaps_m")
    time_gaps_s: PerVehicle | None = _quantity("time_gaps_s")
    speeds_mps: PerVehicle | None = _quantity("speeds_mps")
    line_speed_mps: Quantity | None = _quantity("line_speed_mps")
    speed_deviations_mps: PerVehicle = _quantity("speed_deviations_mps", 0.0)
    braking_capacity_mps2: PerVehicle | None = _quantity("braking_capacity_mps2")
    driving_capacity_mps2: PerVehicle | None = _quantity("driving_capacity_mps2")
    mass_t: PerVehicle | None = _quantity("mass_t")
    latency_s: PerVehicle | None = _quantity("latency_s")
    speed_limit_mps: PerVehicle = _quantity("speed_limit_mps", 40.0)
    restitution: Quantity = _quantity("restitution", 0.1)
    roles: dict[str, Annotated[str, AfterValidator(check_role)]] = Field(
        default_factory=lambda data: Roles.complete({"vehicle_2": LEARNER}, data.get("vehicles", 3)),
        description="role of each vehicle: learner, or the name of a script; a vehicle without an entry brakes fully",
    )
    obstacle_gap_m: Quantity | None = _quantity("obstacle_gap_m")
    obstacle_margin_m: Quantity | None = _quantity("obstacle_margin_m")
    friction: Quantity | None = _quantity("friction", exclude_if=not_)
    grip: PerVehicle | None = _quantity("grip", exclude_if=not_)
    brake_rate_mps3: PerVehicle | None = _quantity("brake_rate_mps3", exclude_if=not_)
    release_rate_mps3: PerVehicle | None = _quantity("release_rate_mps3", exclude_if=not_)
    alert_s: Quantity | None = _quantity("alert_s", exclude_if=not_)
    early_impacts: Literal["keep", "reject"] = Field(
        default="keep", description="keep or reject worlds with an impact at or before the first decision of a learner"
    )
    objective: str | Annotated[tuple[str, ...], Field(strict=False)] = Field(
        default="total",
        description="whose harm a reward counts: one objective for all vehicles, or a list with one per vehicle",
        examples=["own", "weighted:1,4,1", "weighted:1,1,1000"],
    )
    physics: str | None = Field(
        default=None, exclude_if=not_, description="name of a physics other than exact impacts, such as paper-map"
    )
    observation: Observation | None = Field(
        default=None,
        exclude_if=not_,
        description="features and groups of features that a vehicle observes, in this order: one list for all"
        " vehicles, or a mapping from vehicle names to lists",
    )
    v2x: V2X = Field(
        default_factory=V2X,
        description="what each vehicle knows, and when: name of a preset, or a mapping with settings of your own",
    )

    def __init__(self, /, **data: Any) -> None:
        name = data.get("name")
        self._build(Document(f"scenario {name!r}" if isinstance(name, str) else "scenario", plain(data), {}))

    @classmethod
    def from_document(cls, document: Document) -> Self:
        """Error messages contain file and line."""
        scenario = cls.__new__(cls)
        scenario._build(document)
        return scenario

    def _build(self, document: Document) -> None:
        if not isinstance(document.content, dict):
            raise InvalidInput(f"{document.file}: must be a mapping of keys to values, for instance name: my-scenario")
        try:
            BaseModel.__init__(self, **document.content)
        except ValidationError as error:
            raise explain(document, error, ScenarioWording(Scenario)) from None

    @model_validator(mode="before")
    @classmethod
    def _with_members(cls, content: dict[str, Any]) -> dict[str, Any]:
        return with_members(content, cls) if "mixture" in content else content

    @field_validator("table")
    @classmethod
    def _cells(cls, value: Table, info: ValidationInfo) -> Table:
        if "vehicles" in info.data:
            value.check_cells(table_columns((*USUAL, *OPTIONAL), info.data["vehicles"]))
        return value

    @field_validator(*QUANTITIES)
    @classmethod
    def _entries(cls, value: Any, info: ValidationInfo) -> Any:
        rule = QUANTITIES[str(info.field_name)]
        if "vehicles" in info.data:
            check_length(value, rule.count(info.data["vehicles"]), rule.per)
        is_list = isinstance(value, tuple)
        for index, entry in enumerate(value if is_list else (value,)):
            rule.check(entry, (index,) if is_list else ())
        return value

    @field_validator("roles", "objective", "observation")
    @classmethod
    def _of_vehicles(cls, value: Any, info: ValidationInfo) -> Any:
        vehicles = info.data.get("vehicles", 64)
        for name in value if isinstance(value, dict) else ():
            check_vehicle(name, vehicles, (name,), UNSHOWN)
        if info.field_name == "objective":
            objectives_of(value, vehicles)
        return Roles.complete(value, vehicles) if info.field_name == "roles" else value

    @model_validator(mode="after")
    def _whole(self) -> Self:
        if self.mixture is None:  # otherwise its members have been checked
            check_scenario(self)
        return self

    def __repr__(self) -> str:
        learners = ", ".join(self.vehicle_names[i - 1] for i in self.learners) or "nobody"
        return f"Scenario({self.name!r}: {self.vehicles} vehicles, learning: {learners})"

    __str__ = __repr__

    # ---- its worlds

    def sample(self, n: int, seed: int, *, first: int = 0, purpose: Purpose = "list") -> State:
        """Worlds ``first`` to ``first + n - 1`` of the endless list of the seed, at the alert.

        World k always has the same bits. A seed has two independent lists: ``purpose="list"`` for evaluation,
        ``"training"`` for training. Raises ``InvalidInput`` for bad arguments, and if ``early_impacts: reject`` leaves
        no world.
        """
        world_numbers(n, seed, first, purpose)
        return self._pools[purpose](n, seed, first)

    def draw(self, n: int, seed: int, *, first: int = 0, purpose: Purpose = "list") -> DrawnWorlds:
        """The worlds of ``sample``, with values that their state does not contain."""
        return draw_worlds(self, n, seed, first, purpose)

    @cached_property
    def _pools(self) -> dict[Purpose, WorldPool]:
        return {"list": WorldPool(self, "list"), "training": WorldPool(self, "training")}

    # ---- who is in the line

    @property
    def members(self) -> tuple[Scenario, ...]:
        """Each with the keys that stand next to ``mixture``; empty if this is no mixture."""
        return tuple(entry.scenario for entry in self.mixture or ())

    @cached_property
    def vehicle_names(self) -> tuple[str, ...]:
        """Front to rear."""
        return names_of(self.vehicles)

    @cached_property
    def learners(self) -> tuple[int, ...]:
        """1: Vehicle 1."""
        return tuple(i + 1 for i, name in enumerate(self.vehicle_names) if self.roles[name] == LEARNER)

    @property
    def has_obstacle(self) -> bool:
        declares_obstacle = not {"obstacle_gap_m", "obstacle_margin_m"}.isdisjoint(self.sources)
        return declares_obstacle or any(member.has_obstacle for member in self.members)

    def unheard(self, types: Ints | None = None) -> Bools:
        """Whether vehicle i cannot get messages of vehicle j because of their types' V2X equipment, [n, N (i), N (j)].

        ``types`` [n, N]: number of each vehicle's type. None: whether some possible types of i and j exclude messages,
        [1, N, N].
        """
        if self.types_of_line is None:
            return np.zeros((1, self.vehicles, self.vehicles), np.bool_)
        return self.types_of_line.unheard(types)

    # ---- its quantities

    @cached_property
    def types_of_line(self) -> TypesOfLine | None:
        return None if self.vehicle_types is None else TypesOfLine(self.vehicle_types, self.types, self.vehicles)

    @property
    def columns(self) -> dict[str, TableColumn]:
        return {} if self.table is None else self.table.by_name

    @cached_property
    def sources(self) -> dict[str, list[dict[int, Any]]]:
        """Where the values of each declared quantity come from: key -> list with an entry for each vehicle or pair, or
        a single entry for a quantity of the whole world.

        An entry maps each possible vehicle type, by number (0 without types), to a constant, a distribution or a column
        of the table.
        """
        sources = {}
        for key, rule in QUANTITIES.items():
            declaration, line, entries = getattr(self, key), self.types_of_line if key in OF_A_TYPE else None, []
            for i, outside in enumerate(
                declaration if isinstance(declaration, tuple) else (declaration,) * rule.count(self.vehicles)
            ):
                column = self.columns.get(rule.column_of(i))
                by_type = {0: outside if column is None else column}
                if line is not None and column is None:
                    kinds = {kind: getattr(line.kinds[kind], key) for kind in np.flatnonzero(line.possible[i]).tolist()}
                    by_type = {kind: outside if inside is None else inside for kind, inside in kinds.items()}
                entries.append(by_type)
            if all(quantity is not None for by_type in entries for quantity in by_type.values()):
                sources[key] = entries
        return sources

    def bounds(self, key: str) -> tuple[tuple[float, float], ...]:
        """Capacities include the limit that the road's friction sets. An undeclared rate of the brakes counts as the
        largest valid rate.
        """
        at_once = np.full((2, self.vehicles), QUANTITIES[key].high)
        member_bounds = [world_values(member, member.ends).get(key, at_once) for member in self.members or (self,)]
        lows, highs = np.min(member_bounds, axis=0)[0], np.max(member_bounds, axis=0)[1]
        return tuple(zip(lows.tolist(), highs.tolist(), strict=True))

    def ends(self, key: str) -> Floats:
        """Smallest and largest value of a declared quantity, [2, entries]."""
        supports = [np.array([support(quantity) for quantity in entry.values()]) for entry in self.sources[key]]
        return np.array([(ends[:, 0].min(), ends[:, 1].max()) for ends in supports]).T

    # ---- its content, and scenarios like it

    def declared(self) -> dict[str, Any]:
        """``Scenario(**scenario.declared())`` equals the scenario."""
        return self.model_dump(mode="json", exclude_unset=True, exclude_none=True)

    def content(self, without: Sequence[str] = ()) -> dict[str, Any]:
        """With defaults, without the titles of a mixture's members."""
        without_words: dict[str, Any] = {"mixture": {"__all__": {"scenario": {*DESCRIPTIVE_KEYS}}}}
        return self.model_dump(mode="json", exclude=without_words | dict.fromkeys(without, True))

    def replace(self, **changes: Any) -> Scenario:
        """Such as ``replace(mass_t=2.0)``; in a mixture every member changes.

        A new way to declare gaps, speeds or an obstacle (``time_gaps_s``) replaces the old one (``gaps_m``). A key that
        becomes None returns to its default.
        """
        return Scenario(**changed_content(self.declared(), changes))

    def with_learners(self, learners: Iterable[str]) -> Scenario:
        """The scenario with exactly these learners, such as ``["vehicle_2"]``. Former learners brake fully. Raises
        ``InvalidInput``.
        """
        if isinstance(learners, str) or not isinstance(learners, Iterable):
            raise InvalidInput(f"learners = {learners!r}: must be a list of vehicles, for instance ['vehicle_2']")
        other_roles = {name: "full_brake" if role == LEARNER else role for name, role in self.roles.items()}
        return self.replace(roles={**other_roles, **dict.fromkeys(learners, LEARNER)})


def plain(value: Any) -> Any:
    """``value`` as plain dictionaries, lists, numbers and texts."""
    if isinstance(value, BaseModel):
        return value.model_dump(mode="json", exclude_unset=True, exclude_none=True)
    if isinstance(value, View):
        return list(value.names)
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    if isinstance(value, PurePath | Enum):
        return str(value) if isinstance(value, PurePath) else value.value
    if isinstance(value, Mapping):
        return {key: plain(entry) for key, entry in value.items()}
    if isinstance(value, Sequence) and not isinstance(value, str | bytes):
        return [plain(entry) for entry in value]
    return value
