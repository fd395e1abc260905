"""A sweep: read a list of training runs (jobs) from a YAML file, do them on Ray Tune, and write one table of results.

The table is computed only from the folders of the training runs. It is the same, byte for byte, in whatever order and
on whatever computers the training runs are done, and however often they are interrupted. In ``SweepPlan``, ``path`` is
the sweep's folder (in the method ``read``: the sweep's file).
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, NamedTuple, Self

from pydantic import AfterValidator, Discriminator, Field, GetJsonSchemaHandler, Tag, field_validator
from pydantic.json_schema import JsonSchemaValue
from pydantic_core import CoreSchema

from ethbrake_marl.errors import InvalidInput, count_of
from ethbrake_marl.extensions.studies.cluster import connected
from ethbrake_marl.extensions.studies.figures import FIGURES, REASON, final_figures, finish, is_done
from ethbrake_marl.extensions.studies.folder import StudyFolder
from ethbrake_marl.extensions.studies.study_file import Seed, StudyFile, load_parts, refused_part, texts_of
from ethbrake_marl.extensions.studies.trainings import TrainingJob
from ethbrake_marl.files.json_schema import FileSchema
from ethbrake_marl.files.model import FileModel
from ethbrake_marl.files.sheet import csv_text
from ethbrake_marl.files.store import remove_unfinished, write_file
from ethbrake_marl.files.yaml import YamlPath, flow_text
from ethbrake_marl.parallel import LOCAL
from ethbrake_marl.progress import OnProgress, Progress
from ethbrake_marl.training.training import Training

MOST_JOBS = 10_000

_GRID: YamlPath = ("grid",)


class _OneOrMore:
    """Annotation of a field that accepts a list or, instead of a list with one entry, this entry itself.

    The annotation changes only the JSON Schema; ``Grid._one_is_a_list_of_one`` turns a single entry into a list.
    """

    @classmethod
    def __get_pydantic_json_schema__(cls, core: CoreSchema, handler: GetJsonSchemaHandler) -> JsonSchemaValue:
        several = handler(core)
        return {"anyOf": [several["items"], several]}


_Names = Annotated[tuple[str, ...], Field(strict=False, min_length=1), _OneOrMore]

_Values = Annotated[tuple[Any, ...], Field(strict=False, min_length=1)]


def _check_keys(value: dict[str, Any]) -> dict[str, Any]:
    for key in value:
        if key in ("seed", "recipe.seed"):
            raise ValueError("the seed must not stand under set; write the key seed next to the key recipe")
        if "=" in key:
            raise ValueError(f"{flow_text(key, 60)}: a key must not contain the character =; write KEY: VALUE")
    return value


_Settings = Annotated[dict[str, Any], AfterValidator(_check_keys)]


class Request(NamedTuple):
    """One job, as requested in the file of the sweep."""

    path: YamlPath  # place of the training in the file: ``("grid",)``, or ``("jobs", k)`` for a listed job
    scenario: str  # name or path of the scenario
    recipe: str  # name or path of the recipe
    settings: tuple[str, ...]  # ``KEY=VALUE`` texts, as for ``train --set``
    seed: int  # seed of the training

    def __str__(self) -> str:
        """Return the place in the file, scenario, recipe, seed and settings, for messages."""
        settings = f", {', '.join(self.settings)}" if self.settings else ""
        return f"{_place(self.path)} ({self.scenario}, {self.recipe}, seed {self.seed}{settings})"


def _place(path: YamlPath) -> str:
    return "grid" if path == _GRID else f"jobs[{path[1]}]"


class SeedRange(FileModel):
    """Seeds of the training runs as a range of ``count`` whole numbers: ``first``, ``first`` + 1, and so on."""

    first: Seed = Field(default=0, description="smallest seed")
    count: int = Field(ge=1, le=MOST_JOBS, description="number of seeds")


_Seeds = Annotated[
    Annotated[tuple[Seed, ...], Field(strict=False, min_length=1), _OneOrMore, Tag("#list")]
    | Annotated[SeedRange, Tag("#range")],
    Discriminator(lambda value: "#range" if isinstance(value, dict | SeedRange) else "#list"),
]


class Grid(FileModel):
    """Grid of training runs: one run for every combination of the listed scenarios, recipes, settings and seeds."""

    settings: Annotated[dict[str, _Values], AfterValidator(_check_keys)] = Field(
        default={},
        alias="set",
        description="for each key, written with dots as in ethbrake train --set, a list of values",
    )
    scenario: _Names = Field(description="names or paths of scenarios, as in ethbrake train --scenario")
    recipe: _Names = Field(description="names or paths of recipes, as in ethbrake train --recipe")
    seed: _Seeds = Field(default=(0,), description="seeds of the training runs: a number, a list, or a range")

    @field_validator("scenario", "recipe", "seed", mode="before")
    @classmethod
    def _one_is_a_list_of_one(cls, value: Any) -> Any:
        return (value,) if isinstance(value, str | int) and not isinstance(value, bool) else value

    @property
    def seeds(self) -> Sequence[int]:
        """All seeds of the training runs."""
        if isinstance(self.seed, SeedRange):
            return range(self.seed.first, self.seed.first + self.seed.count)
        return self.seed


class ListedJob(FileModel):
    """One training run of the list ``jobs``: a scenario, a recipe, settings and a seed."""

    settings: _Settings = Field(default={}, alias="set", description="settings of this job, as in ethbrake train --set")
    scenario: str = Field(description="name or path of the scenario, as in ethbrake train --scenario")
    recipe: str = Field(description="name or path of the recipe, as in ethbrake train --recipe")
    seed: Seed = Field(default=0, description="seed of the training run")


class SweepFile(StudyFile):
    """Content of the YAML file of a sweep: training runs as a grid of combinations, as single jobs, or both."""

    settings: _Settings = Field(
        default={}, alias="set", description="settings of every job, as in ethbrake train --set"
    )
    grid: Grid | None = Field(default=None, description="one job (training run) for every combination of these values")
    jobs: tuple[ListedJob, ...] = Field(
        default=(), strict=False, description="single jobs (training runs), in addition to the grid"
    )

    def size(self) -> int:
        grid = self.grid
        lists = [] if grid is None else [grid.scenario, grid.recipe, grid.seeds, *grid.settings.values()]
        return (math.prod(map(len, lists)) if lists else 0) + len(self.jobs)

    def requests(self) -> Iterator[Request]:
        """Yield all jobs: first the jobs of the grid, ordered by seed, then the jobs of the list ``jobs``."""
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
        """Return the line that requests a job, as text for messages: ``sweep.yaml, line 7``.

        If ``part`` is ``recipe``, ``scenario`` or the key of a setting, the text names the line of this entry.
        """
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
            raise InvalidInput(
                f"{where}: {key}: the file sets {twice[0]} twice: here, and for all jobs at the top of the file;"
                " delete one of the two"
            )
        return texts_of({**self.settings, **own})


TABLE, FAILURES, RUNS = "results.csv", "failures.csv", "runs"  # names inside the folder


@dataclass(frozen=True, slots=True)
class Row:
    """One job, checked and loaded. Its results become one row of the table."""

    asked: Request  # job as requested in the file
    identity: str  # SHA-256 of everything that affects the training (``Training.identity``)
    name: str  # name of the job and of its folder
    first: Training  # training with the settings of the job but possibly another seed; shared by jobs of equal settings

    @property
    def settings(self) -> dict[str, str]:
        """Settings of the job: key -> value, both as text."""
        return dict(text.split("=", 1) for text in self.asked.settings)

    @property
    def about(self) -> dict[str, Any]:
        """Columns of the table that describe the job, such as ``scenario`` and ``seed``."""
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
    """All jobs of a sweep, checked and loaded, in the order of the table."""

    rows: Sequence[Row]  # the jobs

    @staticmethod
    def json_schema() -> dict[str, Any]:
        """Return the JSON Schema of a sweep file, for editors."""
        schema = SweepFile.model_json_schema(schema_generator=FileSchema)
        return FileSchema.publish(
            {**schema, "title": "Sweep", "anyOf": [{"required": ["grid"]}, {"required": ["jobs"]}]}
        )

    @classmethod
    def read(cls, path: str | Path) -> Self:
        """Read the file of a sweep, and load the scenario and the recipe of every job.

        Raises ``InvalidInput``, which names the file, the line and the job, if a scenario, a recipe or a setting is
        unknown, if the scenario, recipe and settings of a job do not fit together, or if two jobs request the same
        training run.
        """
        file = SweepFile.read_as(path, "with a grid or a list of jobs")
        if not 1 <= file.size() <= MOST_JOBS:
            raise InvalidInput(
                f"{path}: the file requests {count_of(file.size(), 'job')}; a sweep has from 1 to {MOST_JOBS:,} jobs"
            )
        rows: list[Row] = []
        firsts: dict[object, tuple[Training, dict[str, dict[str, Any]]]] = {}
        seen: dict[str, Request] = {}
        for asked in file.requests():
            kind = asked[1:-1]
            if kind not in firsts:
                try:
                    scenario, recipe = load_parts(*kind)
                    first = Training.of(recipe, scenario, seed=asked.seed)
                except InvalidInput as error:
                    raise type(error)(f"{file.where(asked, refused_part(*kind))}: {asked}: {error}") from None
                firsts[kind] = first, first.content()
            first, content = firsts[kind]
            content["recipe"]["seed"] = asked.seed  # a seed changes nothing else
            identity = Training.identity_of(content)
            if identity in seen:
                raise InvalidInput(
                    f"{file.where(asked)}: {asked}: this job trains the same policy as {seen[identity]}; delete one"
                    " of the two"
                )
            seen[identity] = asked
            name = f"{first.scenario.name}-{first.recipe.name}-seed{asked.seed}-{identity[:16]}"
            rows.append(Row(asked, identity, name, first))
        return cls(rows)

    @staticmethod
    def folder(path: Path) -> StudyFolder:
        """Return a ``StudyFolder``, which compares no settings: the folder of each job stores its own settings."""
        return StudyFolder(path, "a sweep", writes=(TABLE, FAILURES))

    @staticmethod
    def job(row: Row, path: Path) -> TrainingJob:
        """Return the training run of the job ``row``, with its folder."""
        training = Training.of(row.first.recipe, row.first.scenario, seed=row.asked.seed)
        return TrainingJob(training, path / RUNS / row.name, row.asked.settings)

    def train(self, row: Row, path: Path) -> None:
        """Train a job to its end, or continue it if it has begun."""
        finish(self.job(row, path))

    def results(self, path: Path) -> dict[str, dict[str, Any]]:
        """Return the results of the finished jobs, by name of the job.

        The results are ``harm`` and all of ``figures.FIGURES``, by column of the table. Example: ``{"ppo-seed0":
        {"harm": 7.1, "steps": 400000, ...}}``.
        """
        jobs = ((row.name, self.job(row, path)) for row in self.rows)
        return {name: final_figures(job) for name, job in jobs if is_done(job)}

    def states(self, path: Path) -> list[dict[str, Any]]:
        """Return a dictionary for each job, with ``hash``, ``job`` (its name), ``set`` (its settings) and ``state``.

        The state is ``new``, ``begun`` or ``finished``.
        """
        done = self.results(path)
        return [
            {
                "hash": row.identity,
                "job": row.name,
                "set": row.settings,
                "state": "finished" if row.name in done else "begun" if (path / RUNS / row.name).is_dir() else "new",
            }
            for row in self.rows
        ]

    def run(
        self, path: Path, *, jobs: int | None = None, ray: str = LOCAL, retries: int = 2, tell: OnProgress | None = None
    ) -> SweepResult:
        """Run the unfinished jobs, and write the tables of results and of failures, also if Ctrl-C stops the run.

        Raises ``InvalidInput`` if another process works in the folder, or if no cluster runs at the address ``ray``.

        Args:
            path: folder of all results; created if necessary.
            jobs: number of jobs that run at once; None: one for each core.
            ray: address of a Ray cluster; ``local``: Ray is started on this machine.
            retries: number of times that a job is started again after its process ended unexpectedly.
            tell: called with the number of jobs that have ended, and with the reason of each failure.

        """
        with self.folder(path).work():
            (path / RUNS).mkdir(exist_ok=True)
            remove_unfinished(path / RUNS)
            results = self.results(path)
            left = [number for number, row in enumerate(self.rows) if row.name not in results]
            if results and tell is not None:
                note = f"{count_of(len(results), 'job')} finished in an earlier run"
                tell(Progress("sweep", len(results), len(self.rows), note=note))
            reasons = self._train(left, path, jobs, ray, retries, tell) if left else {}
            results = self.results(path)
            failures = [
                {**row.about, "set": " ".join(row.asked.settings), REASON: reasons[row.name]}
                for row in self.rows
                if row.name in reasons
            ]
            keys = dict.fromkeys(key for row in self.rows for key in row.settings)
            table = [
                {
                    **row.about,
                    **{f"set.{key}": row.settings.get(key, "") for key in keys},
                    **{name: results[row.name].get(name, "") for name in FIGURES},
                }
                for row in self.rows
                if row.name in results
            ]
            columns = [*self.rows[0].about, *(f"set.{key}" for key in keys), *FIGURES]
            write_file(path / TABLE, csv_text(table, columns).encode())
            if failures:
                write_file(path / FAILURES, csv_text(failures).encode())
            else:
                (path / FAILURES).unlink(missing_ok=True)
        return SweepResult(path / TABLE, len(self.rows), len(results), len(failures))

    def _train(
        self, left: list[int], path: Path, jobs: int | None, ray: str, retries: int, tell: OnProgress | None
    ) -> dict[str, str]:
        """Train the jobs with the indices ``left`` on Ray; return the reason of each failure, by name of the job."""
        with connected(ray, jobs):
            from ray import tune

            from ethbrake_marl.extensions.studies.trials import TrialCallback, run_trials

            ends = run_trials(
                do_job,
                {"plan": self, "path": path.absolute()},
                path,
                tune.TuneConfig(),
                {"job": tune.grid_search(left)},
                jobs=jobs,
                retries=retries,
                callback=TrialCallback("sweep", len(self.rows) - len(left), len(self.rows), tell),
            )
        named = zip(left, ends, strict=False)  # fewer ends than jobs after Ctrl-C
        return {self.rows[number].name: end[REASON] for number, end in named if REASON in end}


@dataclass(frozen=True, slots=True)
class SweepResult:
    """Result of ``SweepPlan.run``."""

    table: Path  # CSV file with a row for each finished job
    jobs: int  # number of all jobs
    finished: int  # number of jobs that have finished, in this run or in earlier runs
    failed: int  # number of jobs that failed in this run

    @property
    def interrupted(self) -> bool:
        """Whether Ctrl-C stopped the sweep, so that some jobs have neither finished nor failed."""
        return self.finished + self.failed < self.jobs


def do_job(config: dict[str, Any], plan: SweepPlan, path: Path) -> None:
    """Train one job in a worker process of Ray; ``config`` is ``{"job": index in plan.rows}``."""
    plan.train(plan.rows[config["job"]], path)
