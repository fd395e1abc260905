"""``Scenario``: a validated, immutable description of how worlds are drawn."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import Any

import numpy as np
from pydantic import BaseModel, ValidationError, model_validator
from pydantic_core import ErrorDetails

from ethbrake_marl.errors import InvalidInput, unknown_name
from ethbrake_marl.files.json_schema import FileSchema
from ethbrake_marl.files.model import Wording, explain, suggestion
from ethbrake_marl.files.sheet import Sheet
from ethbrake_marl.files.yaml import Document, YamlPath, flow_text
from ethbrake_marl.first_edition.game.definition import Game
from ethbrake_marl.first_edition.scenario.checks import check_whole
from ethbrake_marl.first_edition.scenario.declared import ScenarioFields
from ethbrake_marl.first_edition.scenario.distributions import DISTRIBUTIONS
from ethbrake_marl.first_edition.scenario.fields import QUANTITY
from ethbrake_marl.first_edition.scenario.follower import with_follower
from ethbrake_marl.first_edition.scenario.mixtures import WORDS, build_members, changed_content
from ethbrake_marl.first_edition.scenario.roles import LEARNER
from ethbrake_marl.first_edition.scenario.sample import Sample
from ethbrake_marl.first_edition.scenario.sampling import Channel, sample

_DISTRIBUTION = (
    "{uniform: [low, high]}, {loguniform: [low, high]}, {normal: {mean, sd, low, high}},"
    " {lognormal: {median, sigma, low, high}} or {choice: [a, b, ...]}"
)


class ScenarioWording(Wording):
    """Texts for error messages about the content of a scenario file."""

    def instead(self, key: str) -> str:
        """Return a hint for an unknown key that people often try: another word for friction, or the slope of the road.

        The hint is empty for any other key.
        """
        if "friction" in key or key == "mu":
            return "declare the friction of the road with the key friction, for instance friction: 0.5"
        if key in ("grade", "slope"):
            return (
                "the model has no slopes; for a road downhill, lower the braking capacities by 9.81 x grade m/s2 and"
                " raise the driving capacities as much"
            )
        return ""

    def needed(self, path: YamlPath) -> str:
        """Return advice on what to write into the file at ``path`` (keys and indices), with an example."""
        key = path[-1]
        if path[0] == "mixture":
            return "write, for instance, {scenario: paper-random, weight: 2}"
        if isinstance(key, int):
            return "two numbers [low, high] are needed"
        rule = QUANTITY.declared.get(key)
        if rule is None and len(path) > 1:
            shape = (
                "median: 20, sigma: 1, low: 5, high: 90"
                if "lognormal" in path
                else "mean: 20, sd: 1, low: 18, high: 22"
            )
            return f"a number is needed, as in {{{'log' * ('lognormal' in path)}normal: {{{shape}}}}}"
        if rule is None:
            return f"write, for instance, {key}: my-scenario"
        other = (
            f", or {QUANTITY.alternatives[key]}: {QUANTITY.declared[QUANTITY.alternatives[key]].example}"
            if key in QUANTITY.alternatives
            else ""
        )
        return f"write, for instance, {key}: {rule.example}{other} ({rule.meaning})"

    def owner(self, path: YamlPath) -> str:
        """Return the vehicle or pair whose value is at ``path``, such as ``vehicle_2``; empty if there is none.

        An example of ``path`` is ``("speeds_mps", 1)``.
        """
        rule = QUANTITY.declared.get(str(path[0])) if len(path) > 1 else None
        return rule.owner(path[1]) if rule is not None and isinstance(path[1], int) else ""

    def right(self, detail: ErrorDetails) -> str:
        """Return what would be valid instead of an invalid quantity or an invalid scenario of a mixture.

        For a misspelt distribution, the text contains a suggestion. For any other invalid value, the returned text is
        empty. ``detail`` is one mistake, as pydantic reports it.
        """
        if detail["type"] == "quantity":
            return f"must be a number, {_DISTRIBUTION}{_misspelt(detail['input'])}"
        if detail["type"] == "float_type" and detail["loc"][-1] == "#number":
            return f"must be a number or a distribution, {_DISTRIBUTION}"
        if detail["loc"][:1] == ("mixture",) and detail["loc"][-1] == "scenario":
            return "must be the content of a scenario as a mapping; a scenario's name works only with load_scenario"
        return ""


def _misspelt(given: Any) -> str:
    if isinstance(given, dict) and "with_load" in given:
        return "; with_load is allowed only in vehicle_types"
    hints = [suggestion(key, DISTRIBUTIONS) for key in given if isinstance(key, str)] if isinstance(given, dict) else []
    return "".join(f"; {hint}" for hint in hints if hint)


class Scenario(ScenarioFields):
    """A line of vehicles, the distribution of each quantity, and the vehicles that learn.

    A quantity is a number, ``{uniform: [low, high]}``, ``{loguniform: [low, high]}``,
    ``{normal: {mean, sd, low, high}}``, ``{lognormal: {median, sigma, low, high}}`` or ``{choice: [...]}``. A single
    number or distribution applies to every vehicle; from a distribution, each vehicle draws its own value. A list has
    one entry per vehicle, or per pair for gaps. ``Scenario(...)``, ``load_scenario`` and ``replace`` raise
    ``InvalidInput`` for an invalid value; the message names key and value, and says what would be valid.

    >>> import ethbrake_marl.first_edition as eb
    >>> scenario = eb.load_scenario("paper-random").replace(mass_t=[4.5, 5.5, 40.0])
    >>> scenario.bounds("mass_t")
    ((4.5, 4.5), (5.5, 5.5), (40.0, 40.0))
    >>> scenario.with_learners(["vehicle_3"]).learners
    (2,)
    """

    def __init__(self, /, **data: Any) -> None:
        name = data.get("name")
        document = Document(f"scenario {name!r}" if isinstance(name, str) else "scenario", _plain(data), {})
        _build(self, document)

    @classmethod
    def from_document(cls, document: Document) -> Scenario:
        """Build a scenario from a parsed file; error messages name its file and line."""
        scenario = cls.__new__(cls)
        _build(scenario, document)
        return scenario

    @model_validator(mode="after")
    def _whole(self) -> Scenario:
        if self.mixture is not None:  # its members are checked already
            return self
        check_whole(self)
        return self

    def __repr__(self) -> str:
        learners = ", ".join(self.vehicle_names[i] for i in self.learners) or "nobody"
        return f"Scenario({self.name!r}: {self.vehicles} vehicles, learning: {learners})"

    __str__ = __repr__

    def _repr_html_(self) -> str:
        """Return the declared values as HTML, for a notebook."""
        values = {key: value for key, value in self.declared().items() if key not in ("name", "title")}
        if self.mixture is not None:
            values["mixture"] = ", ".join(f"{e.weight:g} x {e.scenario['name']}" for e in self.mixture)
        rows = [(key, value if isinstance(value, str) else flow_text(value)) for key, value in values.items()]
        return Sheet(f"Scenario {self.name}: {self.title or 'no title'}", ("Key", "Value"), rows).html()

    def sample(self, n: int, seed: int, *, first: int = 0, channel: Channel = "list") -> Sample:
        """Return worlds ``first`` to ``first + n - 1`` of the endless list of worlds that belongs to ``seed``.

        World k of the list is always the same, bit for bit. ``channel`` selects one of two independent lists:
        ``"list"`` (worlds for evaluation) or ``"training"``. Raises ``InvalidInput`` for an invalid ``n``, ``seed`` or
        ``first``. See ``sampling.sample``.
        """
        return sample(self, n, seed, first=first, channel=channel)

    def declared(self) -> dict[str, Any]:
        """Return the declared values as plain data: ``Scenario(**scenario.declared())`` equals the scenario."""
        return self.model_dump(mode="json", exclude_unset=True, exclude_none=True)

    def content(self, without: Collection[str]) -> dict[str, Any]:
        """Return every value of the scenario, including defaults, as plain data, except the keys in ``without``.

        The content of a mixture includes the content of its scenarios, but not their titles, descriptions and sources.
        """
        content = self.model_dump(mode="json", exclude=set(without))
        if self.mixture is not None and self.members:
            content["mixture"] = [
                {"weight": entry.weight, "scenario": member.model_dump(mode="json", exclude=set(WORDS))}
                for entry, member in zip(self.mixture, self.members, strict=True)
            ]
        return content

    def replace(self, **changes: Any) -> Scenario:
        """Return a copy of the scenario with changed values, for example ``replace(mass_t=2.0)``.

        If ``changes`` declares gaps or speeds by another key, such as ``time_gaps_s``, the old key (``gaps_m``) is
        removed. If the scenario is a mixture, the values change in each of its scenarios. Raises ``InvalidInput`` if
        the result is not a valid scenario.
        """
        return Scenario(**changed_content(self.declared(), changes))

    def with_learners(self, learners: Sequence[str | int]) -> Scenario:
        """Return the scenario with exactly these learners, listed by name (``vehicle_2``) or index (from 0).

        A former learner that is not listed brakes fully; all scripts stay as they are. Raises ``InvalidInput`` for an
        unknown vehicle, or a vehicle that is listed twice.
        """
        if isinstance(learners, str):
            raise InvalidInput(f"learners: {learners!r}: must be a list of vehicles, for instance [{learners!r}]")
        chosen = [self._vehicle_name(learner) for learner in learners]
        if twice := {name for name in chosen if chosen.count(name) > 1}:
            raise InvalidInput(f"learners: {', '.join(sorted(twice))} is listed twice")
        stay = {name: "full_brake" if role == LEARNER else role for name, role in self.roles.items()}
        return self.replace(roles={**stay, **dict.fromkeys(chosen, LEARNER)})

    def _vehicle_name(self, vehicle: str | int) -> str:
        if isinstance(vehicle, str):
            if vehicle not in self.vehicle_names:
                raise unknown_name("vehicle", vehicle, self.vehicle_names)
            return vehicle
        if isinstance(vehicle, bool) or not isinstance(vehicle, int | np.integer) or not 0 <= vehicle < self.vehicles:
            raise InvalidInput(
                f"learners: {vehicle!r}: must be the name of a vehicle (vehicle_1 ... vehicle_{self.vehicles}) or its"
                f" index (0 ... {self.vehicles - 1})"
            )
        return self.vehicle_names[vehicle]


def as_scenario(game: Game) -> Scenario:
    """Return ``game`` itself if it is a ``Scenario``; raise ``InvalidInput`` for any other game."""
    if not isinstance(game, Scenario):
        raise InvalidInput(f"game {game.name!r}: is a {type(game).__name__}, but this function needs a Scenario")
    return game


def scenario_json_schema() -> dict[str, Any]:
    """Return the JSON Schema of a scenario file, for editors that complete and check YAML."""
    one_of_two: list[dict[str, Any]] = [
        {"not": {"required": [*pair]}}
        if pair[0] in QUANTITY.optional
        else {"oneOf": [{"required": [key]} for key in pair]}
        for pair in QUANTITY.alternatives.items()
    ]
    by_types = {"anyOf": [{"required": ["vehicle_types"]}, {"required": [*QUANTITY.needed]}]}
    elsewhere = {"anyOf": [{"required": ["mixture"]}, {"required": ["table"]}]}
    whole = {"if": {"not": elsewhere}, "then": {"allOf": [*one_of_two, by_types]}}
    needed = {"speed_deviations_mps": ["line_speed_mps"]}
    schema = Scenario.model_json_schema(schema_generator=FileSchema)
    ranges = {key: _range(key, rule.low, rule.high, rule.positive) for key, rule in QUANTITY.declared.items()}
    ranges["load"] = _range("load", 0.0, 1.0)
    for properties in (schema["properties"], schema["$defs"]["VehicleType"]["properties"]):
        for key in properties.keys() & ranges.keys():
            properties[key]["allOf"] = [_reference(key)]
    defined = schema["$defs"] | {f"range_{key}": limits for key, limits in ranges.items()}
    return FileSchema.publish({**schema, **whole, "dependentRequired": needed, "$defs": defined})


def _reference(key: str) -> dict[str, Any]:
    return {"$ref": f"#/$defs/range_{key}"}


def _range(key: str, low: float, high: float, positive: bool = False) -> dict[str, Any]:
    """Return the JSON schema of a quantity; its numbers, also in distributions and lists, must be in [low, high].

    If ``positive`` is true, ``low`` itself is not allowed.
    """
    limits = {"exclusiveMinimum" if positive else "minimum": low, "maximum": high}
    above = {"exclusiveMinimum": 0}
    inside = dict.fromkeys(("low", "high", "with_load", *DISTRIBUTIONS), _reference(key))
    inside |= {"loguniform": {"items": {**limits, **above}}, "sd": above, "sigma": above, "weights": {"items": above}}
    inside["lognormal"] = {"allOf": [_reference(key)], "properties": {"median": above, "low": above}}
    return {**limits, "items": _reference(key), "properties": inside}


def _build(scenario: Scenario, document: Document) -> None:
    """Check the content of ``document`` and set the fields of the new, empty ``scenario`` from it."""
    if not isinstance(document.content, dict):
        raise InvalidInput(f"{document.file}: must be a mapping of keys to values, for instance name: my-scenario")
    members: tuple[Scenario, ...] = ()
    if "mixture" in document.content:
        document, members = build_members(document, Scenario.from_document)
    if "follower" in document.content:
        document = with_follower(document, Scenario.from_document)
    try:
        BaseModel.__init__(scenario, **document.content)
    except ValidationError as error:
        raise explain(document, error, ScenarioWording(Scenario)) from None
    scenario._members = members


def _plain(value: Any) -> Any:
    """Return ``value`` with numpy numbers and arrays converted to Python numbers and lists, also inside containers.

    A ``Scenario`` becomes its declared values.
    """
    if isinstance(value, Scenario):
        return value.declared()
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    if isinstance(value, dict):
        return {key: _plain(entry) for key, entry in value.items()}
    return [_plain(entry) for entry in value] if isinstance(value, list | tuple) else value
