"""The jobs of a sweep, each known by the hash of its configuration, all checked before the first begins."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.learning.recipe import TrainingRecipe
from ethbrake_marl.learning.training import Training, resolve, training_content, training_identity
from ethbrake_marl.scenario import Scenario
from ethbrake_marl.studies.jobs.parts import load_parts, refused_part
from ethbrake_marl.studies.sweep.file import Request, SweepFile


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
