"""Sweeps: the YAML file of a grid or a list of jobs, checked before anything starts; what is finished is kept."""

from __future__ import annotations

import itertools
import math
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

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

from ethbrake_marl.errors import InvalidInput, OnProgress, Progress, count_of, naming_extras
from ethbrake_marl.files.sheet import csv_text
from ethbrake_marl.files.store import new_file, remove_unfinished, write_file
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
from ethbrake_marl.learning.training import RunDirectory, Training, resolve, training_content, training_identity
from ethbrake_marl.policies.bundle import has_bundle
from ethbrake_marl.scenario import Scenario
from ethbrake_marl.studies.jobs import RETRIES, Attempt, Job, JobFolder, Workers
from ethbrake_marl.studies.trainings import (
    RESULTS,
    Timed,
    TrainingJob,
    load_parts,
    reach_results,
    refused_part,
    time_training,
    told_seconds,
)

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

    def job(self, row: Row, folder: Path) -> TrainingJob:
        """The training, and its place in the folder of a sweep."""
        return TrainingJob(self.training(row), folder.absolute() / RUNS / row.name, row.asked.settings)

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


# What a sweep leaves: a table with one row per finished job in the order of the file, and one with each failure.
#
# The first is made of the plan and of what the jobs found alone, so that it is the same, byte for byte, in whatever
# order and wherever they ran, and however often they were stopped. Times, attempts and places stand in the journal.

TableFormat = Literal["csv", "parquet"]
FAILURES = "failures.csv"
RUNS = "runs"  # inside the sweep's folder
_LAST_LINES, _TAIL_BYTES = 10, 8192  # of what a failed job printed
_ABOUT = ("hash", "scenario", "level", "recipe", "algorithm", "scheme", "seed", "total_steps")
_WHOLE = {"seed", "total_steps", "steps", "policy_steps"}
_TEXT = {"hash", "scenario", "level", "recipe", "algorithm", "scheme", "policy_sha256"}

JobOf = Callable[[SweepPlan, Row, Path, Path], Job]


@dataclass(frozen=True, slots=True)
class SweepResult:
    """What a sweep left behind."""

    table: Path
    finished: int
    failed: int
    jobs: int
    interrupted: bool


def training_job(plan: SweepPlan, row: Row, folder: Path, log: Path) -> Job:
    """What trains the job of a row."""
    return Job(row.name, reach_results, (plan.job(row, folder), log))


def run_sweep(
    plan: SweepPlan,
    folder: Path,
    workers: Workers,
    *,
    retries: int = RETRIES,
    form: TableFormat = "csv",
    tell: OnProgress | None = None,
    job_of: JobOf = training_job,
) -> SweepResult:
    """Run what is left of a sweep and write its tables, after Ctrl-C too.

    Args:
        plan: all jobs.
        folder: of everything; made if it is not there.
        workers: where jobs run; not closed here.
        retries: further attempts at a job that was lost.
        form: of the table, which is called ``results``.
        tell: is told how many jobs have ended, and how each failed.
        job_of: makes the job of a row.

    Raises what ``JobFolder.work`` raises.

    """
    kept = JobFolder(folder, "a sweep")
    say = tell or (lambda progress: None)
    with kept.work():
        (folder / RUNS).mkdir(exist_ok=True)
        remove_unfinished(folder / RUNS)
        results, damaged = kept_results(plan, kept)
        left = {row.name: row for row in plan.rows if row.name not in results}
        failures: dict[str, dict[str, Any]] = {}

        def note(attempt: Attempt) -> None:
            name, told = attempt.job.name, ""
            if attempt.answer.value is not None:
                results[name] = attempt.answer.value
            elif attempt.last:
                told = f"{name}: {attempt.reason}"
                ended = {"attempts": attempt.attempt, "reason": attempt.reason}
                failures[name] = {**_about(left[name]), "set": " ".join(left[name].asked.settings), **ended}
                failures[name]["last_lines"] = _last_lines(kept.log(name))
            else:
                told = f"{name}: {attempt.reason}; tried again after attempt {attempt.attempt}"
            say(Progress("sweep", len(results) + len(failures), len(plan.rows), note=told))

        notes = [f"{len(results):,} jobs are finished already"] if results else []
        notes += [f"{damaged} damaged lines of the journal: their jobs are looked at again"] if damaged else []
        say(Progress("sweep", len(results), len(plan.rows), note="; ".join(notes)))
        jobs = (job_of(plan, row, folder, kept.log(row.name)) for row in left.values())
        whole = kept.run(jobs, workers, note, retries=retries)
        table = _write_tables(folder, plan, results, [failures[name] for name in left if name in failures], form)
    return SweepResult(table, len(results), len(failures), len(plan.rows), not whole)


def kept_results(plan: SweepPlan, folder: JobFolder) -> tuple[dict[str, list[str]], int]:
    """What the finished jobs of this plan found, by name, and the damaged lines of the journal.

    A job whose run's folder was taken away, or the kept policy in it, is to be done again.
    """
    found, damaged = folder.kept()
    results = {}
    for row in plan.rows:
        if row.name not in found:
            continue
        run, values = RunDirectory(folder.path / RUNS / row.name), found[row.name]
        hashes = values[RESULTS.index("policy_sha256")].split()
        named = [text.rpartition("=")[0] for text in hashes]  # vehicle_i of several, of one policy nothing
        if run.status.is_file() and all(has_bundle(run.policy / name) for name in named):
            results[row.name] = values
    return results, damaged


def _last_lines(log: Path) -> str:
    """The end of what a job printed."""
    if not log.is_file():
        return ""
    with log.open("rb") as file:
        file.seek(max(log.stat().st_size - _TAIL_BYTES, 0))
        return "\n".join(file.read().decode("utf-8", "replace").splitlines()[-_LAST_LINES:])


def _about(row: Row) -> dict[str, Any]:
    asked = row.asked
    values = (row.identity, asked.scenario, asked.level, asked.recipe, row.algorithm, row.scheme, asked.seed, row.steps)
    return dict(zip(_ABOUT, values, strict=True))


def _write_tables(
    folder: Path,
    plan: SweepPlan,
    results: Mapping[str, Sequence[str]],
    failures: Sequence[Mapping[str, Any]],
    form: TableFormat,
) -> Path:
    """Write the table of the finished jobs, give its path, and write that of the failures where there are any.

    A setting's column is called ``set.KEY``. Parquet has numbers for results and text for settings.
    """
    path = folder / f"results.{form}"
    columns = [*_ABOUT, *(f"set.{key}" for key in plan.keys), *RESULTS]
    rows = (
        {
            **_about(row),
            **{f"set.{key}": value for key, value in row.settings.items()},
            **dict(zip(RESULTS, results[row.name], strict=True)),
        }
        for row in plan.rows
        if row.name in results
    )
    if form == "csv":
        write_file(path, csv_text(rows, columns).encode())
    else:
        _write_parquet(path, columns, list(rows))
    if failures:
        write_file(folder / FAILURES, csv_text(failures).encode())
    else:
        (folder / FAILURES).unlink(missing_ok=True)
    return path


def _write_parquet(path: Path, columns: Sequence[str], rows: Sequence[Mapping[str, Any]]) -> None:
    with naming_extras():
        import pyarrow as pa
        import pyarrow.parquet as pq
    arrays = {}
    for name in columns:
        kind: str = "float64"
        read: Callable[[str], Any] = float
        if name in _WHOLE:
            kind, read = "int64", int
        elif name in _TEXT or name.startswith("set."):
            kind, read = "string", str
        values = [row.get(name, "") for row in rows]
        arrays[name] = pa.array([read(value) if value != "" else None for value in values], getattr(pa, kind)())
    with new_file(path) as partial:
        pq.write_table(pa.table(arrays), partial)


# The cost of what is left of a sweep, told before anything is begun.


@dataclass(frozen=True, slots=True)
class SweepCost:
    """Seconds of one core for what is left to do; begun jobs are reckoned whole."""

    states: Mapping[str, str]  # by job's name: finished, begun or new
    jobs: int  # that are left
    decisions: int
    work_s: float
    recipes: int  # one job of each was timed

    def in_words(self, processes: int) -> str:
        """The cost in one line, for so many at once."""
        if not self.jobs:
            return "to do: nothing"
        return (
            f"to do: {count_of(self.jobs, 'job')}, {self.decisions:,} decisions: about {told_seconds(self.work_s)}"
            f" of one core, {told_seconds(self.work_s / processes)} with {processes} at once"
            f" (a few updates of {count_of(self.recipes, 'recipe')} timed on this machine)"
        )


def cost_of(plan: SweepPlan, folder: Path) -> SweepCost:
    """Time a short training of the first job of each recipe, and reckon up what is left."""
    results, _ = kept_results(plan, JobFolder(folder, "a sweep"))
    left = [row for row in plan.rows if row.name not in results]
    begun = {row.name: "begun" if (folder / RUNS / row.name / "run.json").is_file() else "new" for row in left}
    steps: Counter[Row] = Counter()
    first: dict[object, Row] = {}
    for row in left:
        steps[first.setdefault(row.asked.kind, row)] += row.steps
    timed: dict[str, Timed] = {}
    work_s = 0.0
    for row, decisions in steps.items():
        training = plan.training(row)
        if row.asked.recipe not in timed:
            timed[row.asked.recipe] = time_training(training)
        work_s += timed[row.asked.recipe].seconds(training, decisions)
    states = {**{row.name: "finished" for row in plan.rows}, **begun}
    return SweepCost(states, len(left), sum(steps.values()), work_s, len(timed))
