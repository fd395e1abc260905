"""Tunings: a file with the ranges of some settings of a recipe, Optuna's study, and trials that are kept."""

from __future__ import annotations

import hashlib
import itertools
import json
import math
import uuid
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
from pydantic import (
    AfterValidator,
    Discriminator,
    Field,
    PlainValidator,
    PrivateAttr,
    Tag,
    WithJsonSchema,
    model_validator,
)

from ethbrake_marl.errors import InvalidInput, OnProgress, Progress, count_of, describe_error, naming_extras
from ethbrake_marl.files.plugins import noted_plugins
from ethbrake_marl.files.sheet import csv_text
from ethbrake_marl.files.store import remove_unfinished, write_file
from ethbrake_marl.files.yaml import Document, FileModel, Wording, flow_text, publish, read_model, read_yaml
from ethbrake_marl.learning.progress import HARM_METRIC, OBJECTIVE
from ethbrake_marl.learning.recipe import TrainingRecipe, load_recipe, read_settings, recipe_text
from ethbrake_marl.learning.training import RunDirectory, Training, resolve, training_content
from ethbrake_marl.policies.actor import installed_versions
from ethbrake_marl.scenario import Scenario
from ethbrake_marl.scenario.schema import check_file_name
from ethbrake_marl.studies.jobs import RETRIES, Attempt, Job, JobFolder, Workers
from ethbrake_marl.studies.trainings import (
    RESULTS,
    TrainingJob,
    load_parts,
    reach_results,
    read_results,
    refused_part,
    time_training,
)

if TYPE_CHECKING:
    from optuna import Trial
    from optuna.distributions import BaseDistribution
    from optuna.pruners import BasePruner
    from optuna.trial import FrozenTrial

_Seed = Annotated[int, Field(ge=0, lt=2**32)]
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
        """A value as the storage has it."""
        return value

    def value(self, stored: Any) -> int | float:
        """What the storage has as a value."""
        return int(stored) if self.whole else float(stored)


class Choices(FileModel):
    """One of a list of values, of any kind."""

    choices: tuple[Any, ...] = Field(strict=False, min_length=2, description="values of any kind that the recipe takes")

    def __str__(self) -> str:
        """The values in words."""
        return f"one of {', '.join(flow_text(value) for value in self.choices)}"

    @model_validator(mode="after")
    def _once_each(self) -> Choices:
        texts = [flow_text(value) for value in self.choices]
        twice = [text for k, text in enumerate(texts) if text in texts[:k]]
        if twice:
            raise ValueError(f"{twice[0]} stands there twice")
        return self

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

        return CategoricalDistribution([flow_text(value) for value in self.choices])

    def stored(self, value: Any) -> str:
        """A value as the storage has it: its text, for a storage keeps no lists."""
        return flow_text(value)

    def value(self, stored: Any) -> Any:
        """What the storage has as a value."""
        return {flow_text(value): value for value in self.choices}[stored]


def _form(value: Any) -> str:
    return "#choices" if isinstance(value, Choices) or (isinstance(value, dict) and "choices" in value) else "#range"


Dimension = Annotated[
    Annotated[Range, Tag("#range")] | Annotated[Choices, Tag("#choices")],
    Discriminator(_form),
]


def _check_keys(value: dict[str, Any]) -> dict[str, Any]:
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


class TuningFile(FileModel):
    """The whole file."""

    title: str = Field(default="", description="one line, for you")
    scenario: str = Field(description="a name or a path, as train --scenario")
    recipe: str = Field(description="a name or a path, as train --recipe")
    seed: _Seed = Field(default=0, description="of every training")
    settings: Annotated[dict[str, Any], AfterValidator(_check_keys)] = Field(
        default={}, alias="set", description="settings of every trial, as train --set"
    )
    search: Annotated[dict[str, Dimension], AfterValidator(_check_keys)] = Field(
        min_length=1, description="the space: a dotted key of the recipe, with a range or a list of choices"
    )
    measure: Measuring = Field(default=Measuring(), description="the list on which trials are judged, and how often")
    prune: Pruning | None = Field(default=Pruning(), description="when a trial is given up; null: never")
    sampler: Sampling = Field(default=Sampling(), description="who proposes")
    _document: Document = PrivateAttr(Document("the tuning", {}, {}))  # where it stands, for messages

    def refusing_at(self, *path: str | int) -> AbstractContextManager[None]:
        """Begin the message of an ``InvalidInput`` from inside with file and line of what stands at ``path``."""
        return self._document.refusing_at(path)


def read_tuning(path: str | Path) -> TuningFile:
    """Read the file of a tuning; raises ``InvalidInput`` with file, line, key, value and what would be right."""
    document = read_yaml(path)
    wording = Wording(TuningFile, "it is needed; docs/tuning.md shows an example")
    found = read_model(document, TuningFile, wording, "with scenario, recipe and search")
    found._document = document
    return found


def tuning_json_schema() -> dict[str, Any]:
    """JSON Schema of the file of a tuning, for editors that complete and check YAML."""
    return publish({**TuningFile.model_json_schema(), "title": "Tuning"})


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
_NOT_SET = ("seed", "evaluation")
_TRIED = 200  # points of the space that are checked before anything starts


@dataclass(frozen=True)
class TuningPlan:
    """What every trial has in common."""

    file: TuningFile
    recipe: TrainingRecipe  # with the file's settings, its seed and its list
    scenario: Scenario
    question: Mapping[str, Any]  # all that makes a trial's harm what it is, versions and plug-ins included

    @property
    def identity(self) -> str:
        """SHA-256 of the question."""
        return hashlib.sha256(json.dumps(self.question, sort_keys=True).encode()).hexdigest()

    def training(self, values: Values) -> Training:
        """The training of a trial; raises ``InvalidInput`` where the values do not go together."""
        given = read_settings(texts_of(values), [self.recipe])
        recipe = self._measured(given.change(self.recipe))
        return resolve(recipe, self.scenario)

    def updates(self, recipe: TrainingRecipe) -> int:
        """Updates of a whole training."""
        return -(-recipe.total_steps // (recipe.n_envs * len(self.scenario.learners) * recipe.rounds))

    def seconds_per_trial(self) -> float:
        """Seconds of one core for a training with the recipe's own values, by a short one."""
        training = self.training({})
        return time_training(training).seconds(training, training.recipe.total_steps)

    def own_values(self) -> dict[str, Any] | None:
        """The values that the recipe has, None where one of them is not in the space."""
        content = self.recipe.model_dump(mode="json")
        own = {key: dimension.own(_value_at(content, key)) for key, dimension in self.file.search.items()}
        return None if None in own.values() else own

    def _measured(self, recipe: TrainingRecipe) -> TrainingRecipe:
        """The recipe with the tuning's list, measured so often that all trials can be compared on the way."""
        asked = self.file.measure
        every = -(-self.updates(recipe) // asked.times)
        return recipe.replace(evaluation={"every_updates": every, "worlds": asked.worlds, "seed": asked.seed})


def plan_tuning(file: TuningFile) -> TuningPlan:
    """Resolve the file and try its space.

    Raises ``InvalidInput``: an unknown scenario or recipe, a key that the recipe does not have or that is not to be
    searched, a value that it does not allow, values that do not go together.
    """
    with file.refusing_at("recipe"):
        recipe = load_recipe(file.recipe)
    for key in file.search:
        with file.refusing_at("search", key):
            _check_searched(key, recipe, file)
    scenario, changed = _set_parts(file)
    with file.refusing_at("scenario"):
        resolve(changed, scenario)
    content = training_content(changed, scenario)
    told = {"training": content, **file.model_dump(mode="json", include={"search", "measure", "prune", "sampler"})}
    told |= {"order": [*file.search], "versions": installed_versions(), "plugins": noted_plugins()}
    plan = TuningPlan(file, changed, scenario, told)
    _check_space(plan)
    return plan


def texts_of(values: Values) -> tuple[str, ...]:
    """The values as ``KEY=VALUE``."""
    return tuple(f"{key}={flow_text(value)}" for key, value in values.items())


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


def _set_parts(file: TuningFile) -> tuple[Scenario, TrainingRecipe]:
    """Scenario and recipe with what the file sets."""
    for key in file.settings:
        with file.refusing_at("set", key):
            if key.removeprefix("recipe.").partition(".")[0] in _NOT_SET:
                raise InvalidInput(f"set.{key}: is no setting here; give seed and measure beside it")
    asked = file.scenario, file.recipe, texts_of(file.settings)
    try:
        scenario, recipe = load_parts(*asked)
    except InvalidInput:
        part = refused_part(*asked)
        with file.refusing_at(*(("set", part) if part in file.settings else (part or "set",))):
            raise
    return scenario, recipe.replace(seed=file.seed)


def _check_space(plan: TuningPlan) -> None:
    """Raise ``InvalidInput`` for an end that the recipe does not allow, and for ends or points that do not fit."""
    for key, dimension in plan.file.search.items():
        with plan.file.refusing_at("search", key):
            _check_dimension(plan, key, dimension)
    with plan.file.refusing_at("search"):
        for point in _points(plan):
            _check_point(plan, point)


def _check_dimension(plan: TuningPlan, key: str, dimension: Range | Choices) -> None:
    own = _value_at(plan.recipe.model_dump(mode="json"), key)
    if isinstance(dimension, Range) and not dimension.whole and type(own) is int:
        try:
            plan.training({key: math.nextafter(dimension.low, math.inf)})
        except InvalidInput:
            written = f"{{low: {dimension.low!r}, high: {dimension.high!r}}}"  # with the points that make it wrong
            right = "must be whole numbers, written without a decimal point"
            raise InvalidInput(f"search.{key} = {written}: {right}") from None
    for value in dimension.ends():
        _check_point(plan, {key: value})


def _check_point(plan: TuningPlan, values: Values) -> None:
    try:
        plan.training(values)
    except InvalidInput as error:
        raise InvalidInput(f"search, at {', '.join(texts_of(values))}: {error}") from None


def _points(plan: TuningPlan) -> Iterator[dict[str, Any]]:
    """All low, all high, and points by chance, the same ones each time."""
    search = plan.file.search
    for end in (0, -1):
        yield {key: dimension.ends()[end] for key, dimension in search.items()}
    random = np.random.default_rng(0)
    for _ in itertools.repeat(None, _TRIED):
        yield {key: dimension.draw(random) for key, dimension in search.items()}


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
_OWNER, _HASH, _RESULTS, _REASON = "folder", "hash", "results", "reason"  # what we note of a trial in the storage
_DIGITS = 32  # of a study's name


@dataclass(frozen=True, slots=True)
class Place:
    """Where a study stands: a journal file or an address as Optuna takes it; what is searched, and its hash."""

    storage: str
    identity: str
    file: TuningFile

    @property
    def private(self) -> bool:
        """Whether it is a file that nobody else uses."""
        return "://" not in self.storage

    def __str__(self) -> str:
        """For messages: without what an address may hold of passwords."""
        return self.storage if self.private else f"{self.storage.partition('://')[0]}://..."


@dataclass(frozen=True, slots=True)
class TrialRecord:
    """What the storage says of a trial."""

    number: int  # from 0
    state: State
    values: dict[str, Any]  # as YAML has them; empty where it was killed while it was asked for
    owner: str  # the folder that asked for it, by its record
    identity: str  # of its training; empty before it has begun
    harm: float | None  # m2/s2 on the tuning's list, of a finished one
    results: tuple[str, ...]  # a sweep's ``RESULTS``; empty where there are none
    reason: str  # why it failed


class TuningStudy:
    """A study; made where there is none.

    Raises ``InvalidInput`` where the storage cannot be used, ``MissingExtra`` without Optuna.

    """

    def __init__(self, place: Place) -> None:
        with naming_extras():
            import optuna
        from optuna.pruners import NopPruner, PercentilePruner
        from optuna.storages import JournalStorage, RDBStorage
        from optuna.storages.journal import JournalFileBackend

        optuna.logging.set_verbosity(optuna.logging.WARNING)
        self._place, self._search, asked = place, place.file.search, place.file.prune
        pruner: BasePruner = NopPruner()
        if asked is not None:
            few, early = asked.after_trials, asked.after_times
            pruner = PercentilePruner(100.0 * asked.keep, n_startup_trials=few, n_warmup_steps=early)
        try:
            storage = JournalStorage(JournalFileBackend(place.storage)) if place.private else RDBStorage(place.storage)
            name = f"ethbrake-{place.identity[:_DIGITS]}"
            self._study = optuna.create_study(
                storage=storage, study_name=name, pruner=pruner, direction="minimize", load_if_exists=True
            )
        except Exception as error:  # whatever the driver of a database raises
            raise InvalidInput(f"storage {place}: cannot be used ({describe_error(error)})") from None

    def trials(self) -> list[TrialRecord]:
        """Every trial, by its number."""
        return sorted(map(self._record, self._study.get_trials(deepcopy=False)), key=lambda each: each.number)

    def trial(self, number: int) -> TrialRecord:
        """One of them."""
        return self._record(self._frozen(number))

    def best(self) -> TrialRecord | None:
        """The finished trial of least harm, of equals the first; None where none has finished."""
        finished = [each for each in self.trials() if each.harm is not None and each.values]
        return min(finished, key=lambda each: (each.harm, each.number), default=None)

    def ask(self, owner: str) -> int:
        """Propose a trial, and give its number."""
        from optuna.samplers import RandomSampler, TPESampler

        trial, asked = self._study.ask(), self._place.file.sampler
        trial.set_user_attr(_OWNER, owner)
        seed = int(np.random.SeedSequence([asked.seed, trial.number]).generate_state(1)[0])
        if asked.name == "random":
            self._study.sampler = RandomSampler(seed=seed)
        else:
            self._study.sampler = TPESampler(seed=seed, n_startup_trials=asked.random_trials)
        for key, dimension in self._search.items():
            trial._suggest(key, dimension.distribution())  # what suggest_float and its like call
        return trial.number

    def enqueue(self, values: Values) -> None:
        """Let the next proposal be this one, unless some trial has these values already."""
        stored = {key: self._search[key].stored(value) for key, value in values.items()}
        self._study.enqueue_trial(stored, skip_if_exists=True)

    def note_identity(self, number: int, identity: str) -> None:
        """Note which training a trial is."""
        self._running(number).set_user_attr(_HASH, identity)

    def report(self, number: int, step: int, harm: float) -> None:
        """Tell what a running trial measured; what is there for this step stays."""
        if step not in self._frozen(number).intermediate_values:
            self._running(number).report(harm, step)

    def prunes(self, number: int) -> bool:
        """Whether a running trial should stop, by what it has measured last."""
        return self._running(number).should_prune()

    def end(
        self, number: int, state: State, *, results: Sequence[str] = (), harm: float | None = None, reason: str = ""
    ) -> None:
        """End a trial that is finished, with its harm, that was pruned, or that failed, with the reason."""
        from optuna.trial import TrialState

        trial = self._running(number)
        trial.set_user_attr(*((_REASON, reason) if state == "failed" else (_RESULTS, json.dumps(list(results)))))
        names = {told: name for name, told in _STATES.items()}
        self._study.tell(number, harm, TrialState[names[state]])

    def _frozen(self, number: int) -> FrozenTrial:
        return next(each for each in self._study.get_trials(deepcopy=False) if each.number == number)

    def _running(self, number: int) -> Trial:
        """A trial that another call, or another process, has asked for."""
        import optuna

        return optuna.Trial(self._study, self._frozen(number)._trial_id)

    def _record(self, trial: FrozenTrial) -> TrialRecord:
        note, state = trial.user_attrs, _STATES[trial.state.name]
        values: dict[str, Any] = {}
        try:
            results = tuple(str(each) for each in json.loads(note.get(_RESULTS, "[]")))
            if trial.params.keys() == self._search.keys():
                values = {key: dimension.value(trial.params[key]) for key, dimension in self._search.items()}
        except (ValueError, TypeError, LookupError) as error:
            raise InvalidInput(f"storage {self._place}: trial {trial.number} is damaged ({error})") from None
        owner, identity, reason = (str(note.get(what, "")) for what in (_OWNER, _HASH, _REASON))
        harm = trial.value if state == "finished" else None
        return TrialRecord(trial.number, state, values, owner, identity, harm, results, reason)


# One trial, wherever it runs: train, tell the study every measurement, and stop where the study would not go on.

PRUNED = "pruned: too much harm for so many decisions"


def do_trial(job: TrainingJob, place: Place, number: int, updates: int, log: Path) -> dict[str, Any] | None:
    """Train to the end, or to where the trial is pruned: ``pruned`` and ``results``, the values of ``RESULTS``.

    None where it was stopped from outside. Raises what ``reach_results`` raises.

    Args:
        job: the training.
        place: of the study.
        number: of the trial.
        updates: of a whole training.
        log: see ``reach_results``.

    """
    study, times = TuningStudy(place), place.file.measure.times
    harm, pruned = HARM_METRIC[job.training.recipe.reward.harm_count], False

    def judge(evaluation: Mapping[str, float]) -> str | None:
        nonlocal pruned
        step = int(times * evaluation["updates"]) // updates
        study.report(number, step, evaluation.get(OBJECTIVE, evaluation[harm]))
        pruned = bool(step < times and study.prunes(number))
        return PRUNED if pruned else None

    if RunDirectory(job.folder).progress.is_file() and study.prunes(number):  # it was killed before it could say so
        return repeat_end(True, read_results(job))
    found = reach_results(job, log, judge)
    if found is None and not pruned:
        return None
    log.unlink(missing_ok=True)
    return repeat_end(pruned, found or read_results(job))


def repeat_end(pruned: bool, results: Sequence[str]) -> dict[str, Any]:
    """The end of a trial; of one of which the same training has ended before, at once."""
    return {"pruned": pruned, "results": list(results)}


def refuse_trial(reason: str) -> None:
    """A trial whose values do not go together; raises ``InvalidInput``."""
    raise InvalidInput(reason)


# What a tuning leaves: a table with one row per trial, and the recipe of the best one.
#
# No time and no place stands in the table: with one worker it is the same, byte for byte, however often it was stopped.

JOURNAL, RUNS, TABLE = "study.journal", "trials", "trials.csv"  # inside the tuning's folder


@dataclass(frozen=True, slots=True)
class TuningResult:
    """What a tuning left behind."""

    table: Path
    counts: dict[str, int]  # state -> trials of the study
    best: TrialRecord | None
    interrupted: bool


def tuning_folder(plan: TuningPlan, folder: Path) -> JobFolder:
    """The folder, which no other tuning may have."""
    owner = {"format": "ethbrake-tuning", "owner": uuid.uuid4().hex}
    return JobFolder(folder, "a tuning", plan.question, record="tuning.json", more=owner)


def run_tuning(
    plan: TuningPlan,
    folder: Path,
    workers: Workers,
    trials: int,
    *,
    storage: str | None = None,
    retries: int = RETRIES,
    tell: OnProgress | None = None,
) -> TuningResult:
    """Bring the trials of a folder to so many, and write their table, after Ctrl-C too.

    Args:
        plan: what every trial has in common.
        folder: of everything; made if it is not there.
        workers: where trials run; not closed here.
        trials: that this folder shall have altogether.
        storage: an address as Optuna takes it, which other folders may share; None: a journal file in the folder.
        retries: further attempts at a trial that was lost.
        tell: is told how many trials of this folder have ended, how each failed, and of every new least harm.

    Raises what ``JobFolder.work`` raises, and ``InvalidInput`` where the storage cannot be used.

    """
    kept = tuning_folder(plan, folder)
    with kept.work() as record:
        (folder / RUNS).mkdir(exist_ok=True)
        remove_unfinished(folder / RUNS)
        place = place_of(plan, folder, storage)
        if place.private:
            _mend_journal(Path(place.storage))
        tuning = _Tuning(plan, kept, place, str(record.get("owner")), tell or (lambda progress: None))
        whole = kept.run(tuning.jobs(trials), workers, tuning.note, retries=retries)
        found = tuning.study.trials()
        table = _write_table(folder, plan, found)
    counts = Counter[str](trial.state for trial in found)
    return TuningResult(table, dict(counts), tuning.study.best(), not whole)


def place_of(plan: TuningPlan, folder: Path, storage: str | None) -> Place:
    """Where the study of a tuning in ``folder`` stands."""
    return Place(str(folder.absolute() / JOURNAL) if storage is None else storage, plan.identity, plan.file)


class _Tuning:
    """The trials of one call: those that go on first, then new ones."""

    def __init__(self, plan: TuningPlan, folder: JobFolder, place: Place, owner: str, tell: OnProgress) -> None:
        self._plan, self._folder, self._place, self._owner, self._tell = plan, folder, place, owner, tell
        self.study = TuningStudy(place)
        self._done = self._total = 0

    def jobs(self, trials: int) -> Iterator[Job]:
        """Take up what was begun, then ask for new trials, each when its turn has come, until ``trials`` are there."""
        known, note = self.study.trials(), ""
        if not known:  # the first trial is the recipe as it is, so that the best one can be compared with it
            own = self._plan.own_values()
            if own is None:
                note = "the recipe's own values are not in the space, so no trial has them"
            else:
                self.study.enqueue(own)
        # of this folder; in a file of its own also one that was killed before that was noted
        mine = [each for each in known if each.owner == self._owner or (self._place.private and not each.owner)]
        for trial in mine:
            if trial.state == "running" and not trial.values:
                self.study.end(trial.number, "failed", reason="was killed while it was asked for")
        mine = [trial for trial in mine if trial.values]
        begun = [trial.number for trial in mine if trial.state == "running"]
        self._done, self._total = len(mine) - len(begun), max(trials, len(mine))
        if mine:
            note = f"{count_of(self._done, 'trial')} ended already, {len(begun)} go on"
        self._say(note)
        yield from map(self._job, begun)
        for _ in range(self._total - len(mine)):
            yield self._job(self.study.ask(self._owner))

    def note(self, attempt: Attempt) -> None:
        """Tell the study how an attempt at a trial has ended."""
        number, end = int(attempt.job.name), attempt.answer.value
        if end is None and not attempt.last:
            self._say(f"trial {number}: {attempt.reason}; tried again after attempt {attempt.attempt}")
            return
        self._done += 1
        if end is None:
            self.study.end(number, "failed", reason=attempt.reason)
            self._say(f"trial {number}: {attempt.reason}; {self._folder.log(attempt.job.name)}")
            return
        results = dict(zip(RESULTS, end["results"], strict=True))
        harm = float(results[OBJECTIVE] or results[HARM_METRIC[self._plan.recipe.reward.harm_count]])
        if end["pruned"]:
            self.study.end(number, "pruned", results=end["results"])
        else:
            self.study.end(number, "finished", results=end["results"], harm=harm)
        best = self.study.best()
        self._say(
            f"trial {number}: least harm so far, {harm:.3f}" if best is not None and best.number == number else ""
        )

    def _job(self, number: int) -> Job:
        name, trial = f"{number:04d}", self.study.trial(number)
        try:
            training = self._plan.training(trial.values)
        except InvalidInput as error:
            return Job(name, refuse_trial, (str(error),))
        self.study.note_identity(number, training.identity)
        for other in self.study.trials():
            if other.state == "finished" and other.identity == training.identity:
                return Job(name, repeat_end, (False, other.results))
        noted = texts_of({**self._plan.file.settings, **trial.values})
        job = TrainingJob(training, self._folder.path.absolute() / RUNS / name, noted)
        updates = self._plan.updates(training.recipe)
        return Job(name, do_trial, (job, self._place, number, updates, self._folder.log(name)))

    def _say(self, note: str) -> None:
        self._tell(Progress("tuning", self._done, self._total, note=note))


def _mend_journal(journal: Path) -> None:
    """Take off a last line that was not written to its end; Optuna would read nothing once another line follows it."""
    if not journal.is_file():
        return
    content = journal.read_bytes()
    whole = content.rfind(b"\n") + 1
    if whole < len(content):
        with journal.open("r+b") as file:
            file.truncate(whole)


def _write_table(folder: Path, plan: TuningPlan, trials: Sequence[TrialRecord]) -> Path:
    """Write the table and give its path.

    The values of ``RESULTS`` are those of the kept policy on the tuning's list, of a pruned trial of the best until
    then.
    """
    rows = [
        {
            "trial": trial.number,
            "state": trial.state,
            "hash": trial.identity,
            **{key: flow_text(value) for key, value in trial.values.items()},
            **dict(zip(RESULTS, trial.results, strict=False)),
            "reason": trial.reason,
        }
        for trial in trials
        if trial.state != "waiting"
    ]
    columns = ["trial", "state", "hash", *plan.file.search, *RESULTS, "reason"]
    write_file(folder / TABLE, csv_text(rows, columns).encode())
    return folder / TABLE


def best_recipe(plan: TuningPlan, values: Values, file: Path, source: str) -> str:
    """The text of a recipe that trains what the trial with these values trained, named as its file.

    Raises ``InvalidInput`` for a file whose name cannot be a recipe's.
    """
    check_file_name("recipe", file.stem)
    described = f"Settings of {plan.file.recipe} that `ethbrake study tune` found."
    recipe = plan.training(values).recipe.replace(
        name=file.stem, title=plan.file.title, description=described, source=source
    )
    return recipe_text(recipe, export_head(plan, file))


def export_head(plan: TuningPlan, file: Path) -> str:
    """The first line of an exported recipe, with the settings that are the scenario's: no recipe has them."""
    parts = {*type(plan.recipe).model_fields, "recipe"}
    of_scenario = {
        key: value
        for key, value in plan.file.settings.items()
        if key.startswith("scenario.") or key.partition(".")[0] not in parts
    }
    settings = "".join(f" --set {text}" for text in texts_of(of_scenario))
    command = f"ethbrake train --scenario {plan.file.scenario}{settings} --recipe {file.name}"
    return f"# The best trial of a tuning, trained again: {command}\n"
