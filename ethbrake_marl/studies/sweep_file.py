"""The YAML file of a sweep: a grid, a list of jobs, or both, checked before anything starts."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

from pydantic import (
    AfterValidator,
    ConfigDict,
    Discriminator,
    Field,
    PrivateAttr,
    Tag,
    field_validator,
    model_validator,
)

from ethbrake_marl.errors import InvalidInput, count_of
from ethbrake_marl.files.yaml import (
    Document,
    FileModel,
    FileSchema,
    OneOrMore,
    Wording,
    YamlPath,
    flow_text,
    publish,
    read_model,
    read_yaml,
)
from ethbrake_marl.learning.recipe import TrainingRecipe
from ethbrake_marl.learning.training import Training, resolve, training_content, training_identity
from ethbrake_marl.scenario import Scenario
from ethbrake_marl.studies.jobs import load_parts, refused_part

MOST_JOBS = 200_000
_GRID: YamlPath = ("grid",)
LEVEL = "cooperation-"  # how the scenario of a level of cooperation begins

_Seed = Annotated[int, Field(ge=0, lt=2**32)]
_Names = Annotated[tuple[str, ...], Field(strict=False, min_length=1), OneOrMore]
_Values = Annotated[tuple[Any, ...], Field(strict=False, min_length=1)]


def _check_keys(value: dict[str, Any]) -> dict[str, Any]:
    for key in value:
        if key in ("seed", "recipe.seed"):
            raise ValueError("seed is no setting here; give it beside recipe, as seed")
        if "=" in key:
            raise ValueError(f"{flow_text(key, 60)}: a key has no = in it")
    return value


_Settings = Annotated[dict[str, Any], AfterValidator(_check_keys)]
_Lists = Annotated[dict[str, _Values], AfterValidator(_check_keys)]


@dataclass(frozen=True, slots=True)
class Request:
    """One job as the file asks for it."""

    path: YamlPath  # in the file: of the grid, or of a listed job
    scenario: str  # a name or a path
    level: str  # of cooperation; empty where a scenario was named
    recipe: str  # a name or a path
    seed: int
    settings: tuple[str, ...]  # KEY=VALUE each, as for ``train --set``

    @property
    def place(self) -> str:
        """The path, as messages name it."""
        return _place(self.path)

    @property
    def kind(self) -> tuple[str, str, tuple[str, ...]]:
        """The job without its seed."""
        return self.scenario, self.recipe, self.settings


def _place(path: YamlPath) -> str:
    return "grid" if path == _GRID else f"jobs[{path[1]}]"


class SeedRange(FileModel):
    """``count`` seeds from ``first`` on."""

    first: _Seed = Field(default=0, description="the smallest seed")
    count: int = Field(ge=1, le=MOST_JOBS, description="how many seeds")


def _form_of_seeds(value: Any) -> str:
    return "#range" if isinstance(value, dict | SeedRange) else "#list"


_Seeds = Annotated[
    Annotated[tuple[_Seed, ...], Field(strict=False, min_length=1), OneOrMore, Tag("#list")]
    | Annotated[SeedRange, Tag("#range")],
    Discriminator(_form_of_seeds),
]


class _Lines(FileModel):
    """What a grid and a job have in common: a scenario, or the level of cooperation in its place."""

    model_config = ConfigDict(json_schema_extra={"oneOf": [{"required": ["scenario"]}, {"required": ["level"]}]})

    settings: _Settings = Field(default={}, alias="set", description="settings by dotted key, as train --set")

    @model_validator(mode="after")
    def _one_of_two(self) -> _Lines:
        if (getattr(self, "scenario", None) is None) == (getattr(self, "level", None) is None):
            raise ValueError("give one of the two: scenario, or level (4-all is the scenario cooperation-4-all)")
        return self


class Grid(_Lines):
    """All combinations of what is listed."""

    scenario: _Names | None = Field(default=None, description="names or paths, as train --scenario")
    level: _Names | None = Field(default=None, description="in its place: 3-pair is the scenario cooperation-3-pair")
    recipe: _Names = Field(description="names or paths, as train --recipe")
    seed: _Seeds = Field(default=(0,), description="of the trainings")
    settings: _Lists = Field(default={}, alias="set", description="a list of values for each dotted key")

    @field_validator("scenario", "level", "recipe", "seed", mode="before")
    @classmethod
    def _one_is_a_list_of_one(cls, value: Any) -> Any:
        return (value,) if isinstance(value, str | int) and not isinstance(value, bool) else value

    def seeds(self) -> range | tuple[int, ...]:
        """The seeds."""
        return (
            range(self.seed.first, self.seed.first + self.seed.count) if isinstance(self.seed, SeedRange) else self.seed
        )

    def size(self) -> int:
        """Number of jobs."""
        lists = (self.scenario or self.level or (), self.recipe, self.seeds(), *self.settings.values())
        return math.prod(len(each) for each in lists)


class ListedJob(_Lines):
    """One job."""

    scenario: str | None = Field(default=None, description="a name or a path, as train --scenario")
    level: str | None = Field(default=None, description="in its place: 3-pair is the scenario cooperation-3-pair")
    recipe: str = Field(description="a name or a path, as train --recipe")
    seed: _Seed = Field(default=0, description="of the training")


class SweepFile(FileModel):
    """The whole file; ``settings`` hold for every job."""

    title: str = Field(default="", description="one line, for you")
    settings: _Settings = Field(default={}, alias="set", description="settings of every job, as train --set")
    grid: Grid | None = Field(default=None, description="every combination of what it lists")
    jobs: tuple[ListedJob, ...] = Field(default=(), strict=False, description="single jobs, after those of the grid")
    _document: Document = PrivateAttr(Document("the sweep", {}, {}))  # where it stands, for messages

    def requests(self) -> Iterator[Request]:
        """The jobs: of the grid, seed by seed, so that first results of all are there early; then those listed."""
        if self.grid is not None:
            yield from self._of_grid(self.grid)
        for k, job in enumerate(self.jobs):
            scenario, level = (job.scenario, "") if job.level is None else (LEVEL + job.level, job.level)
            texts = self._texts(job.settings, ("jobs", k))
            yield Request(("jobs", k), str(scenario), level, job.recipe, job.seed, texts)

    def _of_grid(self, grid: Grid) -> Iterator[Request]:
        lines = [(name, "") for name in grid.scenario or ()] + [(LEVEL + name, name) for name in grid.level or ()]
        changes = [
            self._texts(dict(zip(grid.settings, values, strict=True)), _GRID)
            for values in itertools.product(*grid.settings.values())
        ]
        for seed in grid.seeds():
            for (scenario, level), recipe, texts in itertools.product(lines, grid.recipe, changes):
                yield Request(_GRID, scenario, level, recipe, seed, texts)

    def where(self, asked: Request, part: str = "") -> str:
        """File and line of a job; of a ``part`` of it: ``recipe``, ``scenario``, or the key of a setting."""
        path = (*asked.path, "set", part) if part else asked.path
        if part in self.settings:
            path = ("set", part)
        elif part in ("recipe", "scenario"):
            key = "level" if part == "scenario" and asked.level else part
            listed = getattr(self.grid, key) if asked.path == _GRID else ()
            named = {"recipe": asked.recipe, "scenario": asked.scenario, "level": asked.level}[key]
            path = (*asked.path, key, *(k for k, each in enumerate(listed) if each == named))
        return self._document.where(path)

    def _texts(self, own: dict[str, Any], path: YamlPath) -> tuple[str, ...]:
        twice = [key for key in own if key in self.settings]
        if twice:
            where = self._document.where((*path, "set", twice[0]))
            key = f"{_place(path)}.set.{twice[0]}"
            raise InvalidInput(f"{where}: {key}: stands in the file's own set too; leave one of them out")
        return tuple(f"{key}={flow_text(value)}" for key, value in {**self.settings, **own}.items())


def read_sweep(path: str | Path) -> SweepFile:
    """Read the file of a sweep; raises ``InvalidInput`` with file, line, key, value and what would be right."""
    document = read_yaml(path)
    wording = Wording(SweepFile, "it is needed; docs/scaling.md shows an example")
    found = read_model(document, SweepFile, wording, "with a grid or a list of jobs")
    found._document = document
    _check_size(found, document)
    return found


def sweep_json_schema() -> dict[str, Any]:
    """JSON Schema of the file of a sweep, for editors that complete and check YAML."""
    schema = SweepFile.model_json_schema(schema_generator=FileSchema)
    return publish({**schema, "title": "Sweep", "anyOf": [{"required": ["grid"]}, {"required": ["jobs"]}]})


def _check_size(found: SweepFile, document: Document) -> None:
    size = (0 if found.grid is None else found.grid.size()) + len(found.jobs)
    if not 1 <= size <= MOST_JOBS:
        raise InvalidInput(f"{document.file}: asks for {count_of(size, 'job')}; must be from 1 to {MOST_JOBS:,}")


# The jobs of a sweep, each known by the hash of its configuration, all checked before the first begins.


@dataclass(frozen=True, slots=True)
class Row:
    """One job: what was asked for, and what is known of it without resolving it again."""

    asked: Request
    identity: str  # of its training
    name: str  # of its folder
    algorithm: str
    scheme: str
    steps: int  # decisions of learners

    @property
    def settings(self) -> dict[str, str]:
        """Key -> value of each setting, as text."""
        return dict(text.split("=", 1) for text in self.asked.settings)


_Kind = tuple[str, str, tuple[str, ...]]  # of jobs that differ in their seeds alone


@dataclass(frozen=True)
class SweepPlan:
    """All jobs, in the order of the table. What they have in common is loaded once."""

    rows: Sequence[Row]
    _loaded: dict[_Kind, tuple[TrainingRecipe, Scenario]] = field(repr=False)

    def training(self, row: Row) -> Training:
        """What is to be trained."""
        recipe, scenario = self._loaded[row.asked.kind]
        return resolve(recipe, scenario, seed=row.asked.seed)

    @property
    def keys(self) -> list[str]:
        """Every key that some job sets, in the order of the file."""
        different = dict.fromkeys(row.asked.settings for row in self.rows)
        return list(dict.fromkeys(text.partition("=")[0] for settings in different for text in settings))


def plan_sweep(file: SweepFile) -> SweepPlan:
    """Resolve every job.

    Raises ``InvalidInput`` naming the job: an unknown scenario or recipe, a setting that neither has, what does not fit
    each other, two jobs with one hash.
    """
    planned = _Planning(file)
    for asked in file.requests():
        planned.add(asked)
    return SweepPlan(planned.rows, planned.loaded)


@dataclass
class _Planning:
    """The rows so far."""

    file: SweepFile
    rows: list[Row] = field(default_factory=list)
    loaded: dict[_Kind, tuple[TrainingRecipe, Scenario]] = field(default_factory=dict)
    _kinds: dict[_Kind, Training] = field(default_factory=dict)
    _contents: dict[_Kind, dict[str, dict[str, object]]] = field(default_factory=dict)
    _seen: dict[str, Request] = field(default_factory=dict)

    def add(self, asked: Request) -> None:
        """Take in one job; its seed changes nothing else than the recipe's."""
        kind = asked.kind
        if kind not in self._kinds:
            self._load(asked, kind)
        first, content = self._kinds[kind], self._contents[kind]
        content["recipe"]["seed"] = asked.seed
        identity = training_identity(content)
        if identity in self._seen:
            where, other = self.file.where(asked), _describe(self._seen[identity])
            raise InvalidInput(f"{where}: {_describe(asked)}: is the same training as {other}; leave one of them out")
        self._seen[identity] = asked
        recipe = first.recipe
        name = f"{first.scenario.name}-{recipe.name}-seed{asked.seed}-{identity[:16]}"
        self.rows.append(Row(asked, identity, name, recipe.algorithm, first.scheme, recipe.total_steps))

    def _load(self, asked: Request, kind: _Kind) -> None:
        try:
            scenario, recipe = load_parts(asked.scenario, asked.recipe, asked.settings)
            first = resolve(recipe, scenario, seed=asked.seed)
        except InvalidInput as error:
            where = self.file.where(asked, refused_part(asked.scenario, asked.recipe, asked.settings))
            raise type(error)(f"{where}: {_describe(asked)}: {error}") from None
        self.loaded[kind] = (recipe, scenario)
        self._kinds[kind], self._contents[kind] = first, training_content(first.recipe, first.scenario)


def _describe(asked: Request) -> str:
    settings = f", {', '.join(asked.settings)}" if asked.settings else ""
    return f"{asked.place} ({asked.scenario}, {asked.recipe}, seed {asked.seed}{settings})"
