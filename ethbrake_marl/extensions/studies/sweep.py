"""A sweep: the trainings that a YAML file lists, checked before one begins, done on Ray Tune, and one table of them.

The table is made of the runs' folders alone. It is the same, byte for byte, in whatever order and wherever the jobs
ran, and however often they were stopped.
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

    first: Seed = Field(default=0, description="the smallest seed")
    count: int = Field(ge=1, le=MOST_JOBS, description="how many seeds")


_Seeds = Annotated[
    Annotated[tuple[Seed, ...], Field(strict=False, min_length=1), _OneOrMore, Tag("#list")]
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
    seed: Seed = Field(default=0, description="of the training")


class SweepFile(StudyFile):
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
        return texts_of({**self.settings, **own})


TABLE, FAILURES, RUNS = "results.csv", "failures.csv", "runs"  # inside the folder


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
        """The folder of a sweep; its jobs know by themselves what they are."""
        return StudyFolder(path, "a sweep", writes=(TABLE, FAILURES))

    @staticmethod
    def job(row: Row, path: Path) -> TrainingJob:
        """The training of a row in the folder of a sweep."""
        training = Training.of(row.first.recipe, row.first.scenario, seed=row.asked.seed)
        return TrainingJob(training, path / RUNS / row.name, row.asked.settings)

    def train(self, row: Row, path: Path) -> None:
        """Bring the training of a row to its end."""
        finish(self.job(row, path))

    def results(self, path: Path) -> dict[str, dict[str, Any]]:
        """``HARM`` and ``FIGURES`` of each job that is done, by its name."""
        jobs = ((row.name, self.job(row, path)) for row in self.rows)
        return {name: final_figures(job) for name, job in jobs if is_done(job)}

    def states(self, path: Path) -> list[dict[str, Any]]:
        """Every job and its state: new, begun or finished."""
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
        """Do what is left of a sweep and write its tables, after Ctrl-C too.

        Args:
            path: the folder of everything; made if it is not there.
            jobs: at once; None: one for each core.
            ray: address of a Ray cluster; ``local``: this machine alone.
            retries: further attempts at a job whose process was lost.
            tell: hears how many jobs have ended, and why some failed.

        Raises ``InvalidInput`` where another process works in the folder, or where there is no cluster.

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
        """Train the jobs of these numbers; why some failed, by name."""
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
        named = zip(left, ends, strict=False)  # after Ctrl-C some have not begun
        return {self.rows[number].name: end[REASON] for number, end in named if REASON in end}


@dataclass(frozen=True, slots=True)
class SweepResult:
    """What a sweep left behind."""

    table: Path
    jobs: int
    finished: int
    failed: int

    @property
    def interrupted(self) -> bool:
        """Whether some jobs did not come to an end."""
        return self.finished + self.failed < self.jobs


def do_job(config: dict[str, Any], plan: SweepPlan, path: Path) -> None:
    """Train one job, in a process of its own."""
    plan.train(plan.rows[config["job"]], path)
