"""A sweep: the trainings listed in a YAML file, checked first, run on Ray Tune, with one table of results.

The table is made only from the folders of the runs. It is the same, byte for byte, in whatever order, place and number
of attempts the jobs ran.
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
    """Annotation of a list for which the file may contain a single entry instead.

    It only changes the JSON schema; a validator turns a single entry into a list.
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
            raise ValueError("seed is no setting here; give it beside recipe, as seed")
        if "=" in key:
            raise ValueError(f"{flow_text(key, 60)}: a key has no = in it")
    return value


_Settings = Annotated[dict[str, Any], AfterValidator(_check_keys)]


class Request(NamedTuple):
    """One training of a sweep, as the sweep's file requests it."""

    path: YamlPath  # keys that lead to its place in the file: ``("grid",)``, or ``("jobs", k)`` for a listed job
    scenario: str  # name or path of the scenario
    recipe: str  # name or path of the recipe
    settings: tuple[str, ...]  # ``KEY=VALUE`` texts, as for ``train --set``
    seed: int  # seed of the training

    def __str__(self) -> str:
        """Return place, scenario, recipe, seed and settings of the job in words, for messages."""
        settings = f", {', '.join(self.settings)}" if self.settings else ""
        return f"{_place(self.path)} ({self.scenario}, {self.recipe}, seed {self.seed}{settings})"


def _place(path: YamlPath) -> str:
    return "grid" if path == _GRID else f"jobs[{path[1]}]"


class SeedRange(FileModel):
    """Seeds of the trainings as a range: ``count`` seeds, from ``first`` on."""

    first: Seed = Field(default=0, description="the smallest seed")
    count: int = Field(ge=1, le=MOST_JOBS, description="how many seeds")


_Seeds = Annotated[
    Annotated[tuple[Seed, ...], Field(strict=False, min_length=1), _OneOrMore, Tag("#list")]
    | Annotated[SeedRange, Tag("#range")],
    Discriminator(lambda value: "#range" if isinstance(value, dict | SeedRange) else "#list"),
]


class Grid(FileModel):
    """One training for every combination of the listed scenarios, recipes, settings and seeds."""

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
        """The seeds of the trainings, listed one by one."""
        if isinstance(self.seed, SeedRange):
            return range(self.seed.first, self.seed.first + self.seed.count)
        return self.seed


class ListedJob(FileModel):
    """One training: a scenario, a recipe, settings and a seed."""

    settings: _Settings = Field(default={}, alias="set", description="settings by dotted key, as train --set")
    scenario: str = Field(description="a name or a path, as train --scenario")
    recipe: str = Field(description="a name or a path, as train --recipe")
    seed: Seed = Field(default=0, description="of the training")


class SweepFile(StudyFile):
    """Content of the YAML file of a sweep: trainings as a grid of combinations, as a list of single jobs, or both."""

    settings: _Settings = Field(default={}, alias="set", description="settings of every job, as train --set")
    grid: Grid | None = Field(default=None, description="every combination of what it lists")
    jobs: tuple[ListedJob, ...] = Field(default=(), strict=False, description="single jobs, after those of the grid")

    def size(self) -> int:
        """Return the number of jobs that the file requests."""
        grid = self.grid
        lists = [] if grid is None else [grid.scenario, grid.recipe, grid.seeds, *grid.settings.values()]
        return (math.prod(map(len, lists)) if lists else 0) + len(self.jobs)

    def requests(self) -> Iterator[Request]:
        """Yield the jobs: first those of the grid, then the listed ones.

        The grid is ordered by seed, so that first results of all combinations exist early.
        """
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
        """Return file and line of a requested job, for messages: ``sweep.yaml, line 7``.

        ``part`` names a part of the job, whose line is returned instead: ``recipe``, ``scenario``, or the key of a
        setting. Empty: the line of the job itself.
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
            raise InvalidInput(f"{where}: {key}: stands in the file's own set too; leave one of them out")
        return texts_of({**self.settings, **own})


TABLE, FAILURES, RUNS = "results.csv", "failures.csv", "runs"  # names inside the folder


@dataclass(frozen=True, slots=True)
class Row:
    """One job of a sweep, checked and loaded: one row of the sweep's table."""

    asked: Request  # the job as the file requests it
    identity: str  # SHA-256 of everything that affects its training (``Training.identity``)
    name: str  # name of the job and of its folder
    first: Training  # training with the settings of the job, but perhaps another seed; jobs of equal settings share it

    @property
    def settings(self) -> dict[str, str]:
        """Settings of the job: key -> value, as texts."""
        return dict(text.split("=", 1) for text in self.asked.settings)

    @property
    def about(self) -> dict[str, Any]:
        """Columns of the tables that describe the job: hash, scenario, recipe, algorithm, scheme, seed, steps."""
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
    """All jobs of a sweep, checked and loaded, in the order of its table."""

    rows: Sequence[Row]  # the jobs

    @staticmethod
    def json_schema() -> dict[str, Any]:
        """Return the JSON Schema of a sweep's file, for editors that complete and check YAML."""
        schema = SweepFile.model_json_schema(schema_generator=FileSchema)
        return FileSchema.publish(
            {**schema, "title": "Sweep", "anyOf": [{"required": ["grid"]}, {"required": ["jobs"]}]}
        )

    @classmethod
    def read(cls, path: str | Path) -> Self:
        """Read the file of a sweep, and load scenario and recipe of every job.

        Raises ``InvalidInput`` with file, line and job for invalid content: an unknown scenario or recipe, an unknown
        setting, parts that do not fit together, or two jobs with the same hash.
        """
        file = SweepFile.read_as(path, "with a grid or a list of jobs")
        if not 1 <= file.size() <= MOST_JOBS:
            raise InvalidInput(f"{path}: asks for {count_of(file.size(), 'job')}; must be from 1 to {MOST_JOBS:,}")
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
                    f"{file.where(asked)}: {asked}: is the same training as {seen[identity]}; leave one of them out"
                )
            seen[identity] = asked
            name = f"{first.scenario.name}-{first.recipe.name}-seed{asked.seed}-{identity[:16]}"
            rows.append(Row(asked, identity, name, first))
        return cls(rows)

    @staticmethod
    def folder(path: Path) -> StudyFolder:
        """Return the object that checks and locks the folder ``path`` of a sweep.

        The folder itself stores no settings, because each job's folder stores the settings of its training.
        """
        return StudyFolder(path, "a sweep", writes=(TABLE, FAILURES))

    @staticmethod
    def job(row: Row, path: Path) -> TrainingJob:
        """Return the training of the job ``row``, with its folder inside the sweep's folder ``path``."""
        training = Training.of(row.first.recipe, row.first.scenario, seed=row.asked.seed)
        return TrainingJob(training, path / RUNS / row.name, row.asked.settings)

    def train(self, row: Row, path: Path) -> None:
        """Bring the training of the job ``row`` in the sweep's folder ``path`` to its end, from where it stopped."""
        finish(self.job(row, path))

    def results(self, path: Path) -> dict[str, dict[str, Any]]:
        """Return the results of each finished job in the sweep's folder ``path``, by the job's name.

        A result holds the figures of the training by name (``figures.FIGURES``, and ``harm`` of the kept policy), as
        in ``{"ppo-seed0": {"harm": 7.1, "steps": 400000, ...}}``.
        """
        jobs = ((row.name, self.job(row, path)) for row in self.rows)
        return {name: final_figures(job) for name, job in jobs if is_done(job)}

    def states(self, path: Path) -> list[dict[str, Any]]:
        """Return one object for each job: ``hash``, ``job`` (name), ``set`` (settings) and ``state``.

        The state is ``new``, ``begun`` or ``finished``. ``path`` is the sweep's folder.
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
        """Run the remaining jobs of a sweep and write its tables, also after Ctrl-C.

        Args:
            path: folder of all results; created if needed.
            jobs: number of jobs at once; None: one for each core.
            ray: address of a Ray cluster; ``local``: only this machine.
            retries: further attempts at a job whose process was lost.
            tell: called with the number of ended jobs, and reasons of failures.

        Raises ``InvalidInput`` if another process works in the folder, or if there is no cluster.

        """
        with self.folder(path).work():
            (path / RUNS).mkdir(exist_ok=True)
            remove_unfinished(path / RUNS)
            results = self.results(path)
            left = [number for number, row in enumerate(self.rows) if row.name not in results]
            if results and tell is not None:
                note = f"{count_of(len(results), 'job')} finished already"
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
        """Train jobs on Ray, and return the reason of each failed job, by its name.

        ``left`` holds the numbers of the jobs in ``rows``; the other arguments are those of ``run``.
        """
        with connected(ray, jobs):
            from ray import tune

            from ethbrake_marl.extensions.studies.trials import Told, run_trials

            ends = run_trials(
                do_job,
                {"plan": self, "path": path.absolute()},
                path,
                tune.TuneConfig(),
                {"job": tune.grid_search(left)},
                jobs=jobs,
                retries=retries,
                told=Told("sweep", len(self.rows) - len(left), len(self.rows), tell),
            )
        named = zip(left, ends, strict=False)  # fewer ends than jobs after Ctrl-C
        return {self.rows[number].name: end[REASON] for number, end in named if REASON in end}


@dataclass(frozen=True, slots=True)
class SweepResult:
    """Numbers of jobs after a run of a sweep, and the file of its table."""

    table: Path  # CSV file with a row for each finished job
    jobs: int  # number of all jobs
    finished: int  # number of jobs that have finished, including earlier runs
    failed: int  # number of jobs that failed in this run

    @property
    def interrupted(self) -> bool:
        """Whether some jobs neither finished nor failed, because Ctrl-C stopped the run."""
        return self.finished + self.failed < self.jobs


def do_job(config: dict[str, Any], plan: SweepPlan, path: Path) -> None:
    """Train one job, in a worker process of Ray.

    Args:
        config: ``{"job": number}`` with the job's number in ``plan.rows``.
        plan: the sweep.
        path: folder of the sweep.

    """
    plan.train(plan.rows[config["job"]], path)
