"""Sweeps and tunings: many trainings that a YAML file lists, or that Optuna proposes, checked before anything starts.

What is finished is kept, and one table tells what all have reached.
"""

from __future__ import annotations

import hashlib
import itertools
import json
import math
import os
import traceback
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, NamedTuple, Self

import numpy as np
from pydantic import (
    AfterValidator,
    Discriminator,
    Field,
    GetJsonSchemaHandler,
    PlainValidator,
    PrivateAttr,
    Tag,
    WithJsonSchema,
    field_validator,
    model_validator,
)
from pydantic.json_schema import JsonSchemaValue
from pydantic_core import CoreSchema

from ethbrake_marl.errors import (
    AlreadyExists,
    InvalidInput,
    OnProgress,
    Progress,
    count_of,
    describe_error,
    naming_extras,
)
from ethbrake_marl.evaluation import load_runnable
from ethbrake_marl.files.plugins import noted_plugins
from ethbrake_marl.files.sheet import csv_text
from ethbrake_marl.files.store import remove_folder, remove_unfinished, write_file
from ethbrake_marl.files.yaml import (
    Document,
    FileModel,
    FileSchema,
    Wording,
    YamlPath,
    flow_text,
    read_model,
    read_yaml,
)
from ethbrake_marl.learning import RunDirectory, StopAt, Training, TrainingRecipe, load_recipe, read_settings
from ethbrake_marl.policies import Policy, installed_versions, read_trained
from ethbrake_marl.scenario import Scenario, check_file_name, load_scenario
from ethbrake_marl.studies.jobs import Attempt, Job, JobFolder, Timed, TrainingJob, Workers

if TYPE_CHECKING:
    from optuna import Trial
    from optuna.distributions import BaseDistribution
    from optuna.pruners import BasePruner
    from optuna.trial import FrozenTrial

_Seed = Annotated[int, Field(ge=0, lt=2**32)]


class _StudyFile(FileModel):
    """What the files of both have in common."""

    title: str = Field(default="", description="one line, for you")
    _document: Document = PrivateAttr(Document("the file", {}, {}))  # where it stands, for messages

    @classmethod
    def read_as(cls, path: str | Path, page: str, needed: str) -> Self:
        """Read a file; raises ``InvalidInput`` with file, line, key, value and what would be right."""
        document = read_yaml(path)
        found = read_model(document, cls, Wording(cls, f"it is needed; docs/{page}.md shows an example"), needed)
        found._document = document
        return found


def _load_parts(scenario: str, recipe: str, settings: Sequence[str]) -> tuple[Scenario, TrainingRecipe]:
    """Scenario and recipe, each a name or a path, with the settings ``KEY=VALUE`` in them.

    Raises ``InvalidInput`` for what is not known, and for a value that is not allowed.
    """
    loaded = load_recipe(recipe)
    given = read_settings(settings, [loaded])
    return load_runnable(scenario, given.scenario), given.change(loaded)


def _refused_part(scenario: str, recipe: str, settings: Sequence[str]) -> str:
    """The part that is refused by itself where ``_load_parts`` refuses: ``recipe``, ``scenario`` or a setting's key.

    Empty where each by itself is in order.
    """
    tried: dict[str, Callable[[], object]] = {
        "recipe": partial(load_recipe, recipe),
        "scenario": partial(load_scenario, scenario),
        **{text.partition("=")[0]: partial(_load_parts, scenario, recipe, (text,)) for text in settings},
    }
    for part, load in tried.items():
        try:
            load()
        except InvalidInput:
            return part
    return ""


@dataclass(frozen=True, slots=True)
class StudyResult:
    """What a sweep or a tuning left behind."""

    table: Path
    counts: dict[str, int]  # of jobs, or of trials by their state
    interrupted: bool
    best: TrialRecord | None = None  # of a tuning


# The figures of a training for a table: train to the end, then read what the run's folder says of it.

_MEASURED = ("first_impact_harm", "total_harm", "collision_rate")
RESULTS = (
    "steps",  # decisions of learners in whole updates
    "policy_steps",  # decisions after which the kept policy was taken: the best one on the recipe's list
    *_MEASURED,  # of the kept policy on that list
    RunDirectory.OBJECTIVE,  # likewise, where a learner has another objective than total
    *(f"last_{name}" for name in _MEASURED),  # of the last one
    "policy_sha256",  # of the kept policy's manifest, of several vehicle_i=... each
)


def reach_results(job: TrainingJob, log: Path, stop_at: StopAt | None = None) -> list[str] | None:
    """The values of ``RESULTS``, as text; None where the training was stopped before its end, by ``stop_at`` too.

    What is printed goes to ``log``, which is deleted at a good end. Raises what a training raises, ``InvalidInput``
    where the folder of all cannot be seen or the run's folder holds another training, and ``BlockingIOError`` where
    another worker has just begun it.
    """
    if not log.parent.is_dir():
        raise InvalidInput(
            f"{log.parent}: is not there on {os.uname().nodename}; every computer of a cluster must see the sweep's"
            " folder"
        )
    with _printing_to(log):
        run = RunDirectory(job.folder)
        if run.status.is_file():
            run.wait_for_others(60.0)  # a worker that has lost its driver may hold the folder for a moment
            run.check_same(job.training)
            if run.is_finished and not all(
                Policy.stands_in(job.folder / place) for place in job.training.drivers.values()
            ):
                remove_folder(job.folder)  # a finished run has no checkpoint: it is trained anew
        try:
            finished = job.finish(stop_at=stop_at)
        except AlreadyExists as error:  # begun in this moment by a worker that has lost its driver
            raise BlockingIOError(str(error)) from None
        found = _read_results(job) if finished else None
    if found is not None:
        log.unlink(missing_ok=True)
    return found


def _read_results(job: TrainingJob) -> list[str]:
    run = RunDirectory(job.folder)
    table = [row for row in run.rows() if row.get(f"eval/{_MEASURED[0]}")]
    if not table:
        raise InvalidInput(f"{run.progress}: holds no evaluation; delete its folder to train anew")
    harm = RunDirectory.chosen_by(table, job.training.recipe.reward.harm_count, "eval/")
    kept, last = min(table, key=lambda row: float(row[harm])), table[-1]
    trained = read_trained(run.policy)
    if isinstance(trained, Policy):
        sha256 = trained.manifest.manifest_sha256
    else:
        sha256 = " ".join(f"{name}={policy.manifest.manifest_sha256}" for name, policy in trained.drivers.items())
    measured, later = ([row[f"eval/{name}"] for name in _MEASURED] for row in (kept, last))
    return [last["steps"], kept["steps"], *measured, kept.get(f"eval/{RunDirectory.OBJECTIVE}", ""), *later, sha256]


@contextmanager
def _printing_to(log: Path) -> Iterator[None]:
    """What this process prints inside goes to a file, and the end of an error with it."""
    with log.open("a") as file, redirect_stdout(file), redirect_stderr(file):
        try:
            yield
        except BaseException:
            traceback.print_exc()
            raise


# The file of a sweep: a grid, and single jobs beside it.

MOST_JOBS = 200_000
_GRID: YamlPath = ("grid",)


class _OneOrMore:
    """Of a list: in a file a single entry may stand in its place (a check of the model makes it a list)."""

    @classmethod
    def __get_pydantic_json_schema__(cls, core: CoreSchema, handler: GetJsonSchemaHandler) -> JsonSchemaValue:
        several = handler(core)
        return {"anyOf": [several["items"], several]}


_Names = Annotated[tuple[str, ...], Field(strict=False, min_length=1), _OneOrMore]
_Values = Annotated[tuple[Any, ...], Field(strict=False, min_length=1)]


def _check_keys(value: dict[str, Any]) -> dict[str, Any]:
    for key in value:
        if key in ("seed", "recipe.seed"):
            raise ValueError("seed is no setting here; give it beside recipe, as seed")
        if "=" in key:
            raise ValueError(f"{flow_text(key, 60)}: a key has no = in it")
    return value


_Settings = Annotated[dict[str, Any], AfterValidator(_check_keys)]


class Request(NamedTuple):
    """One job as the file asks for it."""

    path: YamlPath  # in the file: of the grid, or of a listed job
    scenario: str  # a name or a path
    recipe: str  # a name or a path
    settings: tuple[str, ...]  # KEY=VALUE each, as for ``train --set``
    seed: int

    def __str__(self) -> str:
        """The job in words."""
        settings = f", {', '.join(self.settings)}" if self.settings else ""
        return f"{_place(self.path)} ({self.scenario}, {self.recipe}, seed {self.seed}{settings})"


def _place(path: YamlPath) -> str:
    return "grid" if path == _GRID else f"jobs[{path[1]}]"


class SeedRange(FileModel):
    """``count`` seeds from ``first`` on."""

    first: _Seed = Field(default=0, description="the smallest seed")
    count: int = Field(ge=1, le=MOST_JOBS, description="how many seeds")


_Seeds = Annotated[
    Annotated[tuple[_Seed, ...], Field(strict=False, min_length=1), _OneOrMore, Tag("#list")]
    | Annotated[SeedRange, Tag("#range")],
    Discriminator(lambda value: "#range" if isinstance(value, dict | SeedRange) else "#list"),
]


class Grid(FileModel):
    """All combinations of what is listed."""

    settings: Annotated[dict[str, _Values], AfterValidator(_check_keys)] = Field(
        default={}, alias="set", description="a list of values for each dotted key"
    )
    scenario: _Names = Field(description="names or paths, as train --scenario")
    recipe: _Names = Field(description="names or paths, as train --recipe")
    seed: _Seeds = Field(default=(0,), description="of the trainings")

    @field_validator("scenario", "recipe", "seed", mode="before")
    @classmethod
    def _one_is_a_list_of_one(cls, value: Any) -> Any:
        return (value,) if isinstance(value, str | int) and not isinstance(value, bool) else value

    @property
    def seeds(self) -> Sequence[int]:
        """The seeds, one by one."""
        if isinstance(self.seed, SeedRange):
            return range(self.seed.first, self.seed.first + self.seed.count)
        return self.seed


class ListedJob(FileModel):
    """One job."""

    settings: _Settings = Field(default={}, alias="set", description="settings by dotted key, as train --set")
    scenario: str = Field(description="a name or a path, as train --scenario")
    recipe: str = Field(description="a name or a path, as train --recipe")
    seed: _Seed = Field(default=0, description="of the training")


class SweepFile(_StudyFile):
    """The whole file; ``settings`` hold for every job."""

    settings: _Settings = Field(default={}, alias="set", description="settings of every job, as train --set")
    grid: Grid | None = Field(default=None, description="every combination of what it lists")
    jobs: tuple[ListedJob, ...] = Field(default=(), strict=False, description="single jobs, after those of the grid")

    def size(self) -> int:
        """Number of jobs."""
        grid = self.grid
        lists = [] if grid is None else [grid.scenario, grid.recipe, grid.seeds, *grid.settings.values()]
        return (math.prod(map(len, lists)) if lists else 0) + len(self.jobs)

    def requests(self) -> Iterator[Request]:
        """The jobs: of the grid, seed by seed, so that first results of all are there early; then those listed."""
        if (grid := self.grid) is not None:
            changes = [
                self._texts(dict(zip(grid.settings, values, strict=True)), _GRID)
                for values in itertools.product(*grid.settings.values())
            ]
            for seed in grid.seeds:
                for scenario, recipe, texts in itertools.product(grid.scenario, grid.recipe, changes):
                    yield Request(_GRID, scenario, recipe, texts, seed)
        for k, job in enumerate(self.jobs):
            yield Request(("jobs", k), job.scenario, job.recipe, self._texts(job.settings, ("jobs", k)), job.seed)

    def where(self, asked: Request, part: str = "") -> str:
        """File and line of a job; of a ``part`` of it: ``recipe``, ``scenario``, or the key of a setting."""
        path = (*asked.path, "set", part) if part else asked.path
        if part in self.settings:
            path = ("set", part)
        elif part in ("recipe", "scenario"):
            listed = getattr(self.grid, part) if asked.path == _GRID else ()
            path = (*asked.path, part, *(k for k, each in enumerate(listed) if each == getattr(asked, part)))
        return self._document.where(path)

    def _texts(self, own: dict[str, Any], path: YamlPath) -> tuple[str, ...]:
        twice = [key for key in own if key in self.settings]
        if twice:
            where = self._document.where((*path, "set", twice[0]))
            key = f"{_place(path)}.set.{twice[0]}"
            raise InvalidInput(f"{where}: {key}: stands in the file's own set too; leave one of them out")
        return _texts_of({**self.settings, **own})


def _texts_of(values: Mapping[str, Any]) -> tuple[str, ...]:
    """The values as ``KEY=VALUE``."""
    return tuple(f"{key}={flow_text(value)}" for key, value in values.items())


# The jobs of a sweep, each known by the hash of its configuration, all checked before the first begins.
#
# The table is made of the plan and of what the jobs found alone, so that it is the same, byte for byte, in whatever
# order and wherever they ran, and however often they were stopped. Times, attempts and places stand in the journal.

FAILURES = "failures.csv"
RUNS = "runs"  # inside the sweep's folder
_LAST_LINES, _TAIL_BYTES = 10, 8192  # of what a failed job printed


@dataclass(frozen=True, slots=True)
class Row:
    """One job: what was asked for, and what is known of it without resolving it again."""

    asked: Request
    identity: str  # of its training
    name: str  # of its folder
    first: Training  # of the job with these settings and the first seed

    @property
    def settings(self) -> dict[str, str]:
        """Key -> value of each setting, as text."""
        return dict(text.split("=", 1) for text in self.asked.settings)

    @property
    def about(self) -> dict[str, Any]:
        """What the tables say of it first."""
        return {
            "hash": self.identity,
            "scenario": self.asked.scenario,
            "recipe": self.asked.recipe,
            "algorithm": self.first.recipe.algorithm,
            "scheme": self.first.scheme,
            "seed": self.asked.seed,
            "total_steps": self.first.recipe.total_steps,
        }


@dataclass(frozen=True)
class SweepPlan:
    """All jobs, in the order of the table. What they have in common is loaded once."""

    rows: Sequence[Row]

    @staticmethod
    def json_schema() -> dict[str, Any]:
        """JSON Schema of the file of a sweep, for editors that complete and check YAML."""
        schema = SweepFile.model_json_schema(schema_generator=FileSchema)
        return FileSchema.publish(
            {**schema, "title": "Sweep", "anyOf": [{"required": ["grid"]}, {"required": ["jobs"]}]}
        )

    @classmethod
    def read(cls, path: str | Path) -> Self:
        """Read the file of a sweep, and resolve every job.

        Raises ``InvalidInput`` with file and line for what the file may not say, and naming the job: an unknown
        scenario or recipe, a setting that neither has, what does not fit each other, two jobs with one hash.
        """
        file = SweepFile.read_as(path, "scaling", "with a grid or a list of jobs")
        if not 1 <= file.size() <= MOST_JOBS:
            raise InvalidInput(f"{path}: asks for {count_of(file.size(), 'job')}; must be from 1 to {MOST_JOBS:,}")
        rows: list[Row] = []
        firsts: dict[object, tuple[Training, dict[str, dict[str, Any]]]] = {}
        seen: dict[str, Request] = {}
        for asked in file.requests():
            kind = asked[1:-1]
            if kind not in firsts:
                try:
                    scenario, recipe = _load_parts(*kind)
                    first = Training.of(recipe, scenario, seed=asked.seed)
                except InvalidInput as error:
                    raise type(error)(f"{file.where(asked, _refused_part(*kind))}: {asked}: {error}") from None
                firsts[kind] = first, first.content()
            first, content = firsts[kind]
            content["recipe"]["seed"] = asked.seed  # a seed changes nothing else
            identity = Training.identity_of(content)
            if identity in seen:
                raise InvalidInput(
                    f"{file.where(asked)}: {asked}: is the same training as {seen[identity]}; leave one of them out"
                )
            seen[identity] = asked
            name = f"{first.scenario.name}-{first.recipe.name}-seed{asked.seed}-{identity[:16]}"
            rows.append(Row(asked, identity, name, first))
        return cls(rows)

    def training(self, row: Row) -> Training:
        """What is to be trained."""
        return Training.of(row.first.recipe, row.first.scenario, seed=row.asked.seed)

    def job(self, row: Row, folder: Path, log: Path) -> Job:
        """What trains the job of a row in the folder of a sweep."""
        training = TrainingJob(self.training(row), folder.absolute() / RUNS / row.name, row.asked.settings)
        return Job(row.name, reach_results, (training, log))

    @staticmethod
    def folder(path: Path) -> JobFolder:
        """The folder of a sweep; its jobs know by themselves what they are."""
        return JobFolder(path, "a sweep")

    def kept(self, path: Path) -> tuple[dict[str, list[str]], int]:
        """What the finished jobs of this plan found, by name, and the damaged lines of the journal.

        A job whose run's folder was taken away, or the kept policy in it, is to be done again.
        """
        found, damaged = self.folder(path).kept()
        results = {}
        for row in self.rows:
            if row.name in found:
                run, values = RunDirectory(path / RUNS / row.name), found[row.name]
                hashes = values[RESULTS.index("policy_sha256")].split()
                named = [text.rpartition("=")[0] for text in hashes]  # vehicle_i of several, of one policy nothing
                if run.status.is_file() and all(Policy.stands_in(run.policy / name) for name in named):
                    results[row.name] = values
        return results, damaged

    def cost(self, path: Path, processes: int) -> tuple[dict[str, Any], str]:
        """Every job and its state, and what is left in seconds of one core, as plain data; the latter in words.

        A short training of the first job of each recipe is timed; begun jobs are reckoned whole.
        """
        results, _ = self.kept(path)
        left = [row for row in self.rows if row.name not in results]
        begun = {row.name for row in left if (path / RUNS / row.name / "run.json").is_file()}
        states = {**dict.fromkeys(results, "finished"), **dict.fromkeys(begun, "begun")}
        jobs = [
            {"hash": row.identity, "job": row.name, "set": row.settings, "state": states.get(row.name, "new")}
            for row in self.rows
        ]
        timed: dict[str, Timed] = {}
        work_s = 0.0
        for row in left:
            job = TrainingJob(row.first, path)
            if row.asked.recipe not in timed:
                timed[row.asked.recipe] = job.time()
            work_s += timed[row.asked.recipe]._replace(job=job).seconds(row.first.recipe.total_steps)
        decisions = sum(row.first.recipe.total_steps for row in left)
        words = (
            f"to do: {count_of(len(left), 'job')}, {decisions:,} decisions: about"
            f" {Timed.in_words(work_s)} of one core, {Timed.in_words(work_s / processes)} with {processes} at once"
            f" (a few updates of {count_of(len(timed), 'recipe')} timed on this machine)"
        )
        return {"jobs": jobs, "decisions_left": decisions, "core_s_left": work_s}, words if left else "to do: nothing"

    def run(self, path: Path, workers: Workers, *, retries: int = 2, tell: OnProgress | None = None) -> StudyResult:
        """Run what is left of a sweep and write its tables, after Ctrl-C too.

        Args:
            path: the folder of everything; made if it is not there.
            workers: where jobs run; not closed here.
            retries: further attempts at a job that was lost.
            tell: is told how many jobs have ended, and how each failed.

        Raises what ``JobFolder.work`` raises.

        """
        kept, say = self.folder(path), tell or (lambda progress: None)
        with kept.work():
            (path / RUNS).mkdir(exist_ok=True)
            remove_unfinished(path / RUNS)
            results, damaged = self.kept(path)
            left = {row.name: row for row in self.rows if row.name not in results}
            failures: dict[str, dict[str, Any]] = {}

            def note(attempt: Attempt) -> None:
                name, told = attempt.job.name, ""
                if attempt.answer.value is not None:
                    results[name] = attempt.answer.value
                elif attempt.last:
                    told, log = f"{name}: {attempt.reason}", kept.log(name)
                    printed = log.read_bytes()[-_TAIL_BYTES:].decode("utf-8", "replace") if log.is_file() else ""
                    failures[name] = {
                        **left[name].about,
                        "set": " ".join(left[name].asked.settings),
                        "attempts": attempt.attempt,
                        "reason": attempt.reason,
                        "last_lines": "\n".join(printed.splitlines()[-_LAST_LINES:]),
                    }
                else:
                    told = f"{name}: {attempt.reason}; tried again after attempt {attempt.attempt}"
                say(Progress("sweep", len(results) + len(failures), len(self.rows), note=told))

            notes = [f"{len(results):,} jobs are finished already"] if results else []
            notes += [f"{damaged} damaged lines of the journal: their jobs are looked at again"] if damaged else []
            say(Progress("sweep", len(results), len(self.rows), note="; ".join(notes)))
            jobs = (self.job(row, path, kept.log(row.name)) for row in left.values())
            whole = kept.run(jobs, workers, note, retries=retries)
            keys = dict.fromkeys(key for row in self.rows for key in row.settings)
            rows = (
                {
                    **row.about,
                    **{f"set.{key}": row.settings.get(key, "") for key in keys},
                    **dict(zip(RESULTS, results[row.name], strict=True)),
                }
                for row in self.rows
                if row.name in results
            )
            columns = [*self.rows[0].about, *(f"set.{key}" for key in keys), *RESULTS]
            write_file(path / "results.csv", csv_text(rows, columns).encode())
            if failures:
                write_file(path / FAILURES, csv_text(failures[name] for name in left if name in failures).encode())
            else:
                (path / FAILURES).unlink(missing_ok=True)
        counts = {"jobs": len(self.rows), "finished": len(results), "failed": len(failures)}
        return StudyResult(path / "results.csv", counts, not whole)


# The file of a tuning: ranges of some settings of a recipe.

_Count = Annotated[int, Field(ge=0, le=1_000_000)]


def _check_number(value: Any) -> int | float:
    """A whole number stays one: it says that whole numbers alone are tried."""
    if not isinstance(value, int | float) or isinstance(value, bool):
        raise ValueError("must be a number")
    if not math.isfinite(value):
        raise ValueError("must be a finite number")
    return value


_Number = Annotated[int | float, PlainValidator(_check_number), WithJsonSchema({"type": "number"})]


class Range(FileModel):
    """From ``low`` to ``high``, both included; whole numbers where both are written without a point."""

    low: _Number = Field(description="the least value, included")
    high: _Number = Field(description="the largest value, included; with low: whole numbers where neither has a point")
    log: bool = Field(default=False, description="the logarithm is searched, not the number")

    def __str__(self) -> str:
        """The range in words."""
        kind = ", whole" * self.whole + ", by its logarithm" * self.log
        return f"from {flow_text(self.low)} to {flow_text(self.high)}{kind}"

    @property
    def whole(self) -> bool:
        """Whether whole numbers alone are tried."""
        return isinstance(self.low, int) and isinstance(self.high, int)

    @model_validator(mode="after")
    def _in_order(self) -> Range:
        if not self.low < self.high:
            raise ValueError(f"low {flow_text(self.low)} must be less than high {flow_text(self.high)}")
        if self.log and not self.low > 0:
            raise ValueError(f"low {flow_text(self.low)} must be greater than 0, for its logarithm is searched")
        return self

    @property
    def ends(self) -> tuple[Any, ...]:
        """The values that are tried before anything starts."""
        return self.low, self.high

    def draw(self, random: np.random.Generator) -> int | float:
        """A value by chance."""
        if self.whole:
            return int(random.integers(int(self.low), int(self.high), endpoint=True))
        low, high = float(self.low), float(self.high)
        return min(low * (high / low) ** random.random(), high) if self.log else float(random.uniform(low, high))

    def own(self, value: Any) -> int | float | None:
        """A recipe's value as it would be tried; None where it is not in the range."""
        if not isinstance(value, int | float) or isinstance(value, bool) or not self.low <= value <= self.high:
            return None
        if not self.whole:
            return float(value)
        return int(value) if value == int(value) else None

    def distribution(self) -> BaseDistribution:
        """The same for Optuna."""
        from optuna.distributions import FloatDistribution, IntDistribution

        if self.whole:
            return IntDistribution(int(self.low), int(self.high), log=self.log)
        return FloatDistribution(float(self.low), float(self.high), log=self.log)

    def stored(self, value: Any) -> Any:
        """A value as the storage has it: as it is."""
        return value

    value = stored


class Choices(FileModel):
    """One of a list of values, of any kind."""

    choices: tuple[Any, ...] = Field(strict=False, min_length=2, description="values of any kind that the recipe takes")

    def __str__(self) -> str:
        """The values in words."""
        return f"one of {', '.join(map(flow_text, self.choices))}"

    @model_validator(mode="after")
    def _once_each(self) -> Choices:
        texts = [*map(flow_text, self.choices)]
        twice = [text for k, text in enumerate(texts) if text in texts[:k]]
        if twice:
            raise ValueError(f"{twice[0]} stands there twice")
        return self

    @property
    def ends(self) -> tuple[Any, ...]:
        """The values that are tried before anything starts."""
        return self.choices

    def draw(self, random: np.random.Generator) -> Any:
        """A value by chance."""
        return self.choices[int(random.integers(len(self.choices)))]

    def own(self, value: Any) -> Any:
        """A recipe's value as it would be tried; None where it is no choice."""
        return next((each for each in self.choices if flow_text(each) == flow_text(value)), None)

    def distribution(self) -> BaseDistribution:
        """The same for Optuna."""
        from optuna.distributions import CategoricalDistribution

        return CategoricalDistribution([*map(flow_text, self.choices)])

    def stored(self, value: Any) -> str:
        """A value as the storage has it: its text, for a storage keeps no lists."""
        return flow_text(value)

    def value(self, stored: Any) -> Any:
        """What the storage has as a value."""
        return {flow_text(value): value for value in self.choices}[stored]


def _form(value: Any) -> str:
    return "#choices" if isinstance(value, Choices) or (isinstance(value, dict) and "choices" in value) else "#range"


Dimension = Annotated[Annotated[Range, Tag("#range")] | Annotated[Choices, Tag("#choices")], Discriminator(_form)]


def _check_recipe_keys(value: dict[str, Any]) -> dict[str, Any]:
    for key in value:
        if not key or "=" in key:
            raise ValueError(f"{flow_text(key, 60)}: must be a key of the recipe, with dots inside a part")
    return value


class Measuring(FileModel):
    """The list by which trials are judged and pruned, and how often in a training."""

    worlds: int = Field(default=1000, ge=1, le=1_000_000, description="of the list")
    seed: _Seed = Field(default=4007, description="of the list")
    times: int = Field(default=10, ge=1, le=1000, description="how often a training is measured")


class Pruning(FileModel):
    """A trial stops whose least harm so far is beyond what the share ``keep`` of the finished ones had by then."""

    keep: float = Field(default=0.5, gt=0.0, lt=1.0, description="the share of finished trials to be as good as")
    after_trials: _Count = Field(default=5, description="so many finish before one is stopped")
    after_times: _Count = Field(default=3, description="nobody is stopped before it was measured so often")


class Sampling(FileModel):
    """Who proposes: Optuna's TPE, or chance."""

    name: Literal["tpe", "random"] = Field(default="tpe", description="Optuna's TPE, or chance")
    seed: _Seed = Field(default=0, description="of what is proposed")
    random_trials: _Count = Field(default=10, description="trials by chance before TPE begins")


class TuningFile(_StudyFile):
    """The whole file."""

    scenario: str = Field(description="a name or a path, as train --scenario")
    recipe: str = Field(description="a name or a path, as train --recipe")
    seed: _Seed = Field(default=0, description="of every training")
    settings: Annotated[dict[str, Any], AfterValidator(_check_recipe_keys)] = Field(
        default={}, alias="set", description="settings of every trial, as train --set"
    )
    search: Annotated[dict[str, Dimension], AfterValidator(_check_recipe_keys)] = Field(
        min_length=1, description="the space: a dotted key of the recipe, with a range or a list of choices"
    )
    measure: Measuring = Field(default=Measuring(), description="the list on which trials are judged, and how often")
    prune: Pruning | None = Field(default=Pruning(), description="when a trial is given up; null: never")
    sampler: Sampling = Field(default=Sampling(), description="who proposes")


# A tuning, resolved: the training that every trial changes, and a search space all of which can be trained.

Values = Mapping[str, Any]  # of a trial: key -> value, as YAML has it

_NOT_SEARCHED = {  # key -> why; what is inside it, too
    "seed": "a seed is luck; give one for all trials, as seed",
    "evaluation": "trials are judged on one list; give it as measure",
    "algorithm": "each algorithm has a recipe of its own; tune one at a time",
    "total_steps": "every trial gets the same number of decisions; give it in set",
    "checkpoint_every_updates": "it changes no result",
    "reward.harm_count": "it says which harm is least; give it in set",
}
_TRIED = 200  # points of the space that are checked before anything starts
# inside the tuning's folder; no time and no place stands in the table: with one worker it is the same, byte for byte,
# however often it was stopped
_STUDY, TRIALS, TRIAL_TABLE = "study.journal", "trials", "trials.csv"


@dataclass(frozen=True)
class TuningPlan:
    """What every trial has in common."""

    file: TuningFile
    recipe: TrainingRecipe  # with the file's settings, its seed and its list
    scenario: Scenario
    question: Mapping[str, Any]  # all that makes a trial's harm what it is, versions and plug-ins included

    @staticmethod
    def json_schema() -> dict[str, Any]:
        """JSON Schema of the file of a tuning, for editors that complete and check YAML."""
        return FileSchema.publish({**TuningFile.model_json_schema(), "title": "Tuning"})

    @classmethod
    def read(cls, path: str | Path) -> TuningPlan:
        """Read the file of a tuning, resolve it and try its space.

        Raises ``InvalidInput`` with file and line: an unknown scenario or recipe, a key that the recipe does not have
        or that is not to be searched, a value that it does not allow, values that do not go together.
        """
        file = TuningFile.read_as(path, "tuning", "with scenario, recipe and search")
        at = file._document.refusing_at
        with at(("recipe",)):
            recipe = load_recipe(file.recipe)
        for key in file.search:
            with at(("search", key)):
                _check_searched(key, recipe, file)
        for key in file.settings:
            with at(("set", key)):
                if key.removeprefix("recipe.").partition(".")[0] in ("seed", "evaluation"):
                    raise InvalidInput(f"set.{key}: is no setting here; give seed and measure beside it")
        asked = file.scenario, file.recipe, _texts_of(file.settings)
        try:
            scenario, recipe = _load_parts(*asked)
        except InvalidInput:
            part = _refused_part(*asked)
            with at(("set", part) if part in file.settings else (part or "set",)):
                raise
        recipe = recipe.replace(seed=file.seed)
        with at(("scenario",)):
            content = Training.of(recipe, scenario).content()
        told = {
            "training": content,
            **file.model_dump(mode="json", include={"search", "measure", "prune", "sampler"}),
            "order": [*file.search],
            "versions": installed_versions(),
            "plugins": noted_plugins(),
        }
        plan = cls(file, recipe, scenario, told)
        for key, dimension in file.search.items():
            with at(("search", key)):
                plan._check_dimension(key, dimension)
        random = np.random.default_rng(0)  # all low, all high, and points by chance, the same ones each time
        points = [
            *({key: each.ends[end] for key, each in file.search.items()} for end in (0, -1)),
            *({key: each.draw(random) for key, each in file.search.items()} for _ in range(_TRIED)),
        ]
        with at(("search",)):
            for point in points:
                plan._check_point(point)
        return plan

    def training(self, values: Values) -> Training:
        """The training of a trial, measured so often that all trials can be compared on the way.

        Raises ``InvalidInput`` where the values do not go together.
        """
        recipe = read_settings(_texts_of(values), [self.recipe]).change(self.recipe)
        asked = self.file.measure
        every = -(-self.updates(recipe) // asked.times)
        listed = {"every_updates": every, "worlds": asked.worlds, "seed": asked.seed}
        return Training.of(recipe.replace(evaluation=listed), self.scenario)

    def updates(self, recipe: TrainingRecipe) -> int:
        """Updates of a whole training."""
        return -(-recipe.total_steps // (recipe.n_envs * len(self.scenario.learners) * recipe.rounds))

    def cost(self, trials: int, processes: int) -> tuple[float, str]:
        """Seconds of one core for a training with the recipe's own values, by a short one; of all trials in words."""
        training = self.training({})
        each_s = TrainingJob(training, Path()).time().seconds(training.recipe.total_steps)
        return each_s, (
            f"{count_of(trials, 'trial')} of {self.recipe.total_steps:,} decisions:"
            f" about {Timed.in_words(trials * each_s)} of one core, {Timed.in_words(trials * each_s / processes)} with"
            f" {processes} at once; less where trials are pruned or have ended already"
            " (a few updates of the recipe timed on this machine)"
        )

    def own_values(self) -> dict[str, Any] | None:
        """The values that the recipe has, None where one of them is not in the space."""
        content = self.recipe.model_dump(mode="json")
        own = {key: dimension.own(_value_at(content, key)) for key, dimension in self.file.search.items()}
        return None if None in own.values() else own

    def _check_dimension(self, key: str, dimension: Range | Choices) -> None:
        own = _value_at(self.recipe.model_dump(mode="json"), key)
        if isinstance(dimension, Range) and not dimension.whole and type(own) is int:
            try:
                self.training({key: math.nextafter(dimension.low, math.inf)})
            except InvalidInput:
                written = f"{{low: {dimension.low!r}, high: {dimension.high!r}}}"  # with the points that make it wrong
                right = "must be whole numbers, written without a decimal point"
                raise InvalidInput(f"search.{key} = {written}: {right}") from None
        for value in dimension.ends:
            self._check_point({key: value})

    def _check_point(self, values: Values) -> None:
        try:
            self.training(values)
        except InvalidInput as error:
            raise InvalidInput(f"search, at {', '.join(_texts_of(values))}: {error}") from None

    def folder(self, path: Path) -> JobFolder:
        """The folder, which no other tuning may have."""
        return JobFolder(path, "a tuning", self.question, record="tuning.json")

    def study(self, path: Path) -> TuningStudy:
        """The study of a tuning in this folder, which stands there."""
        identity = hashlib.sha256(json.dumps(self.question, sort_keys=True).encode()).hexdigest()
        return TuningStudy(path.absolute() / _STUDY, identity, self.file)

    def run(
        self, path: Path, workers: Workers, trials: int, *, retries: int = 2, tell: OnProgress | None = None
    ) -> StudyResult:
        """Bring the trials of a folder to so many, and write their table, after Ctrl-C too.

        Args:
            path: the folder of everything; made if it is not there.
            workers: where trials run; not closed here.
            trials: that this folder shall have altogether.
            retries: further attempts at a trial that was lost.
            tell: is told how many trials have ended, how each failed, and of every new least harm.

        Raises what ``JobFolder.work`` raises, and ``InvalidInput`` where the study cannot be used.

        """
        kept = self.folder(path)
        with kept.work():
            (path / TRIALS).mkdir(exist_ok=True)
            remove_unfinished(path / TRIALS)
            journal = path / _STUDY
            if journal.is_file():  # after a line that was not written to its end Optuna would read nothing
                os.truncate(journal, journal.read_bytes().rfind(b"\n") + 1)
            study = self.study(path)
            known = study.trials()
            is_new = not known
            for trial in known:
                if trial.state == "running" and not trial.values:
                    study.end(trial.number, "failed", reason="was killed while it was asked for")
            known = [trial for trial in known if trial.values]
            begun = [trial.number for trial in known if trial.state == "running"]
            done, total = len(known) - len(begun), max(trials, len(known))

            def say(note: str) -> None:
                if tell is not None:
                    tell(Progress("tuning", done, total, note=note))

            def jobs() -> Iterator[Job]:
                """What was begun, then new trials, each asked for when its turn has come, until all are there."""
                note = f"{count_of(done, 'trial')} ended already, {len(begun)} go on" if known else ""
                if is_new:  # the first is the recipe as it is, so that the best one can be compared with it
                    own = self.own_values()
                    if own is None:
                        note = "the recipe's own values are not in the space, so no trial has them"
                    else:
                        study.enqueue(own)
                say(note)
                yield from (self._job(kept, number) for number in begun)
                yield from (self._job(kept, study.ask()) for _ in range(total - len(known)))

            def note(attempt: Attempt) -> None:
                """Tell the study how an attempt at a trial has ended."""
                nonlocal done
                number, end = int(attempt.job.name), attempt.answer.value
                if end is None and not attempt.last:
                    say(f"trial {number}: {attempt.reason}; tried again after attempt {attempt.attempt}")
                    return
                done += 1
                if end is None:
                    study.end(number, "failed", reason=attempt.reason)
                    say(f"trial {number}: {attempt.reason}; {kept.log(attempt.job.name)}")
                    return
                results = dict(zip(RESULTS, end["results"], strict=True))
                chosen = RunDirectory.HARM[self.recipe.reward.harm_count]
                harm = float(results[RunDirectory.OBJECTIVE] or results[chosen])
                study.end(number, "pruned" if end["pruned"] else "finished", end["results"], harm)
                best = study.best()
                is_best = best is not None and best.number == number
                say(f"trial {number}: least so far, {harm:.3f}" if is_best else "")

            whole = kept.run(jobs(), workers, note, retries=retries)
            found = study.trials()
            rows = [
                {
                    "trial": trial.number,
                    "state": trial.state,
                    "hash": trial.identity,
                    **{key: flow_text(value) for key, value in trial.values.items()},
                    **dict(zip(RESULTS, trial.results, strict=False)),  # of a pruned one the best until then
                    "reason": trial.reason,
                }
                for trial in found
                if trial.state != "waiting"
            ]
            columns = ["trial", "state", "hash", *self.file.search, *RESULTS, "reason"]
            write_file(path / TRIAL_TABLE, csv_text(rows, columns).encode())
        counts = Counter[str](trial.state for trial in found)
        return StudyResult(path / TRIAL_TABLE, dict(counts), not whole, study.best())

    def _job(self, folder: JobFolder, number: int) -> Job:
        name = f"{number:04d}"
        return Job(name, do_trial, (self, folder.path.absolute(), number, folder.log(name)))

    def best_recipe(self, values: Values, file: Path, source: str) -> str:
        """The text of a recipe that trains what the trial with these values trained, named as its file.

        Raises ``InvalidInput`` for a file whose name cannot be a recipe's.
        """
        check_file_name("recipe", file.stem)
        described = f"Settings of {self.file.recipe} that `ethbrake study tune` found."
        recipe = self.training(values).recipe.replace(
            name=file.stem, title=self.file.title, description=described, source=source
        )
        return recipe.text(self.export_head(file))

    def export_head(self, file: Path) -> str:
        """The first line of an exported recipe, with the settings that are the scenario's: no recipe has them."""
        parts = {*type(self.recipe).model_fields, "recipe"}
        of_scenario = {
            key: value
            for key, value in self.file.settings.items()
            if key.startswith("scenario.") or key.partition(".")[0] not in parts
        }
        settings = "".join(f" --set {text}" for text in _texts_of(of_scenario))
        command = f"ethbrake train --scenario {self.file.scenario}{settings} --recipe {file.name}"
        return f"# The best trial of a tuning, trained again: {command}\n"


def _check_searched(key: str, recipe: TrainingRecipe, file: TuningFile) -> None:
    bare = key.removeprefix("recipe.")
    for inner, reason in _NOT_SEARCHED.items():
        if bare == inner or bare.startswith(f"{inner}."):
            raise InvalidInput(f"search.{key}: is not searched: {reason}")
    for other in (*file.settings, *(each for each in file.search if each != key)):
        if f"{bare}.".startswith(f"{other.removeprefix('recipe.')}."):
            raise InvalidInput(f"search.{key}: {other} stands there too; leave one of them out")
    if read_settings([f"{key}=0"], [recipe]).scenario:
        raise InvalidInput(
            f"search.{key}: is the scenario's; a search changes the recipe, so that harms can be compared"
        )


def _value_at(content: Any, key: str) -> Any:
    """What stands at a dotted key; None where nothing does."""
    for part in key.removeprefix("recipe.").split("."):
        if isinstance(content, list) and part.isdecimal() and int(part) < len(content):
            content = content[int(part)]
        elif isinstance(content, Mapping):
            content = content.get(part)
        else:
            return None
    return content


# The study in Optuna's storage: proposals, what was measured on the way, and ends. Nothing else knows Optuna.
#
# Trials are proposed by a sampler that is made anew for each, of the file's seed and the trial's number: what is
# proposed depends on what had ended by then, and not on how often the command was stopped in between.

State = Literal["waiting", "running", "finished", "pruned", "failed"]
_STATES: dict[str, State] = {
    "WAITING": "waiting",
    "RUNNING": "running",
    "COMPLETE": "finished",
    "PRUNED": "pruned",
    "FAIL": "failed",
}
_HASH, _RESULTS, _REASON = "hash", "results", "reason"  # what we note of a trial in the storage


@dataclass(frozen=True, slots=True)
class TrialRecord:
    """What the storage says of a trial."""

    number: int  # from 0
    state: State
    values: dict[str, Any]  # as YAML has them; empty where it was killed while it was asked for
    identity: str  # of its training; empty before it has begun
    harm: float | None  # m2/s2 on the tuning's list, of a finished one
    results: tuple[str, ...]  # a sweep's ``RESULTS``; empty where there are none
    reason: str  # why it failed


class TuningStudy:
    """A study in a journal file; made where there is none.

    Raises ``InvalidInput`` where the file cannot be used, ``MissingExtra`` without Optuna.

    """

    def __init__(self, journal: Path, identity: str, file: TuningFile) -> None:
        with naming_extras():
            import optuna.storages.journal
        optuna.logging.set_verbosity(optuna.logging.WARNING)
        self.journal, self.file, self._optuna = journal, file, optuna
        pruner: BasePruner = optuna.pruners.NopPruner()
        if file.prune is not None:
            pruner = optuna.pruners.PercentilePruner(
                100.0 * file.prune.keep, n_startup_trials=file.prune.after_trials, n_warmup_steps=file.prune.after_times
            )
        try:
            backend = optuna.storages.journal.JournalFileBackend(str(journal))
            self._study = optuna.create_study(
                storage=optuna.storages.JournalStorage(backend),
                study_name=f"ethbrake-{identity[:32]}",
                pruner=pruner,
                direction="minimize",
                load_if_exists=True,
            )
        except Exception as error:  # whatever a damaged file makes Optuna raise
            raise InvalidInput(f"storage {journal}: cannot be used ({describe_error(error)})") from None

    def trials(self) -> list[TrialRecord]:
        """Every trial, by its number."""
        return sorted(map(self._record, self._study.get_trials(deepcopy=False)), key=lambda each: each.number)

    def best(self) -> TrialRecord | None:
        """The finished trial of least harm, of equals the first; None where none has finished."""
        finished = [each for each in self.trials() if each.harm is not None and each.values]
        return min(finished, key=lambda each: (each.harm, each.number), default=None)

    def ask(self) -> int:
        """Propose a trial, and give its number."""
        trial, asked, samplers = self._study.ask(), self.file.sampler, self._optuna.samplers
        seed = int(np.random.SeedSequence([asked.seed, trial.number]).generate_state(1)[0])
        self._study.sampler = (
            samplers.RandomSampler(seed=seed)
            if asked.name == "random"
            else samplers.TPESampler(seed=seed, n_startup_trials=asked.random_trials)
        )
        for key, dimension in self.file.search.items():
            trial._suggest(key, dimension.distribution())  # what suggest_float and its like call
        return trial.number

    def enqueue(self, values: Values) -> None:
        """Let the next proposal be this one, unless some trial has these values already."""
        stored = {key: self.file.search[key].stored(value) for key, value in values.items()}
        self._study.enqueue_trial(stored, skip_if_exists=True)

    def report(self, number: int, step: int, harm: float) -> None:
        """Tell what a running trial measured; what is there for this step stays."""
        if step not in self._frozen(number).intermediate_values:
            self.running(number).report(harm, step)

    def end(
        self, number: int, state: State, results: Sequence[str] = (), harm: float | None = None, reason: str = ""
    ) -> None:
        """End a trial that is finished, with its harm, that was pruned, or that failed, with the reason."""
        noted = (_REASON, reason) if state == "failed" else (_RESULTS, json.dumps(list(results)))
        self.running(number).set_user_attr(*noted)
        names = {told: name for name, told in _STATES.items()}
        self._study.tell(number, harm if state == "finished" else None, self._optuna.trial.TrialState[names[state]])

    def running(self, number: int) -> Trial:
        """A trial that another call, or another process, has asked for."""
        return self._optuna.Trial(self._study, self._frozen(number)._trial_id)

    def _frozen(self, number: int) -> FrozenTrial:
        return next(each for each in self._study.get_trials(deepcopy=False) if each.number == number)

    def _record(self, trial: FrozenTrial) -> TrialRecord:
        note, state, search = trial.user_attrs, _STATES[trial.state.name], self.file.search
        values: dict[str, Any] = {}
        try:
            results = tuple(str(each) for each in json.loads(note.get(_RESULTS, "[]")))
            if trial.params.keys() == search.keys():
                values = {key: dimension.value(trial.params[key]) for key, dimension in search.items()}
        except (ValueError, TypeError, LookupError) as error:
            raise InvalidInput(f"storage {self.journal}: trial {trial.number} is damaged ({error})") from None
        identity, reason = (str(note.get(what, "")) for what in (_HASH, _REASON))
        harm = trial.value if state == "finished" else None
        return TrialRecord(trial.number, state, values, identity, harm, results, reason)


# One trial, wherever it runs: train, tell the study every measurement, and stop where the study would not go on.

PRUNED = "pruned: too much harm for so many decisions"


def do_trial(plan: TuningPlan, path: Path, number: int, log: Path) -> dict[str, Any] | None:
    """Train to the end, or to where the trial is pruned: ``pruned`` and ``results``, the values of ``RESULTS``.

    Where the same training has come to its end before, that end, at once; None where it was stopped from outside.
    Raises ``InvalidInput`` for values that do not go together, and what ``reach_results`` raises.

    Args:
        plan: of the tuning.
        path: its folder.
        number: of the trial.
        log: see ``reach_results``.

    """
    study = plan.study(path)
    known = study.trials()
    training = plan.training(known[number].values)
    study.running(number).set_user_attr(_HASH, training.identity)
    for other in known:
        if other.state == "finished" and other.identity == training.identity:
            return {"pruned": False, "results": list(other.results)}
    noted = _texts_of({**plan.file.settings, **known[number].values})
    job = TrainingJob(training, path / TRIALS / f"{number:04d}", noted)
    times, updates, pruned = plan.file.measure.times, plan.updates(training.recipe), False
    harm = RunDirectory.HARM[training.recipe.reward.harm_count]

    def judge(evaluation: Mapping[str, float]) -> str | None:
        nonlocal pruned
        step = int(times * evaluation["updates"]) // updates
        study.report(number, step, evaluation.get(RunDirectory.OBJECTIVE, evaluation[harm]))
        pruned = bool(step < times and study.running(number).should_prune())
        return PRUNED if pruned else None

    if RunDirectory(job.folder).progress.is_file() and study.running(number).should_prune():
        return {"pruned": True, "results": _read_results(job)}  # it was killed before it could say so
    found = reach_results(job, log, judge)
    if found is None and not pruned:
        return None
    log.unlink(missing_ok=True)
    return {"pruned": pruned, "results": found or _read_results(job)}
