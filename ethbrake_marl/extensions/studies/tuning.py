"""A tuning: search the settings of a recipe for the least harm with Optuna on Ray Tune, with one table of the trials.

The table holds no time or place: with one job at once it is the same, byte for byte, however often the search was
interrupted.
"""

from __future__ import annotations

import math
import shlex
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
from pydantic import AfterValidator, Discriminator, Field, PlainValidator, Tag, WithJsonSchema, model_validator

from ethbrake_marl.errors import InvalidInput, count_of, naming_extras
from ethbrake_marl.extensions.studies.cluster import connected
from ethbrake_marl.extensions.studies.figures import (
    FIGURES,
    HARM,
    REASON,
    Evaluation,
    evaluations_of,
    figures,
    final_figures,
    finish,
)
from ethbrake_marl.extensions.studies.folder import StudyFolder
from ethbrake_marl.extensions.studies.study_file import Seed, StudyFile, load_parts, refused_part, texts_of
from ethbrake_marl.extensions.studies.trainings import TrainingJob
from ethbrake_marl.files.json_schema import FileSchema
from ethbrake_marl.files.model import FileModel
from ethbrake_marl.files.plain import read_object
from ethbrake_marl.files.sheet import csv_text
from ethbrake_marl.files.store import remove_unfinished, write_file
from ethbrake_marl.files.yaml import flow_text
from ethbrake_marl.parallel import LOCAL
from ethbrake_marl.policies.manifest import installed_versions
from ethbrake_marl.progress import OnProgress
from ethbrake_marl.scenario.catalogue import check_file_name
from ethbrake_marl.scenario.schema import Scenario
from ethbrake_marl.training.recipe import TrainingRecipe, load_recipe
from ethbrake_marl.training.settings import read_settings
from ethbrake_marl.training.training import Training

if TYPE_CHECKING:
    from collections.abc import Iterator

    from optuna.distributions import BaseDistribution
    from optuna.samplers import BaseSampler
    from ray.tune.schedulers import TrialScheduler

_Count = Annotated[int, Field(ge=0, le=1_000_000)]


def _check_number(value: Any) -> int | float:
    """Return ``value`` unchanged if it is a finite number, else raise ``ValueError``.

    A whole number stays an ``int``, which limits the search to whole numbers.
    """
    if not isinstance(value, int | float) or isinstance(value, bool):
        raise ValueError("must be a number")
    if not math.isfinite(value):
        raise ValueError("must be a finite number")
    return value


_Number = Annotated[int | float, PlainValidator(_check_number), WithJsonSchema({"type": "number"})]


class Range(FileModel):
    """Numbers that a search may try for one setting: a range from ``low`` to ``high``, both included.

    If both ends are written without a point, only whole numbers are tried.
    """

    low: _Number = Field(description="the least value, included")
    high: _Number = Field(description="the largest value, included; with low: whole numbers where neither has a point")
    log: bool = Field(default=False, description="the logarithm is searched, not the number")

    def __str__(self) -> str:
        """Return the range in words: ``from 0.001 to 0.1, by its logarithm``."""
        kind = ", whole" * self.whole + ", by its logarithm" * self.log
        return f"from {flow_text(self.low)} to {flow_text(self.high)}{kind}"

    @property
    def whole(self) -> bool:
        """Whether only whole numbers are tried: both ends are written without a point."""
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
        """Both ends of the range; the recipe must allow them, which is checked before the search starts."""
        return self.low, self.high

    def own(self, value: Any) -> int | float | None:
        """Return ``value``, a recipe's own value of this setting, as a number of the range; None if it is not in it."""
        if not isinstance(value, int | float) or isinstance(value, bool) or not self.low <= value <= self.high:
            return None
        if not self.whole:
            return float(value)
        return int(value) if value == int(value) else None

    def distribution(self) -> BaseDistribution:
        """Return Optuna's distribution from which values of this range are proposed."""
        from optuna.distributions import FloatDistribution, IntDistribution

        if self.whole:
            return IntDistribution(int(self.low), int(self.high), log=self.log)
        return FloatDistribution(float(self.low), float(self.high), log=self.log)

    def stored(self, value: Any) -> Any:
        """Return a value as Optuna stores it; for a range, this is the value itself."""
        return value

    value = stored


class Choices(FileModel):
    """Values that a search may try for one setting: a list of values of any kind."""

    choices: tuple[Any, ...] = Field(strict=False, min_length=2, description="values of any kind that the recipe takes")

    def __str__(self) -> str:
        """Return the values in words: ``one of relu, tanh``."""
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
        """All choices; the recipe must allow them, which is checked before the search starts."""
        return self.choices

    def own(self, value: Any) -> Any:
        """Return the choice that equals a recipe's own value of this setting; None if it is not one of the choices."""
        return next((each for each in self.choices if flow_text(each) == flow_text(value)), None)

    def distribution(self) -> BaseDistribution:
        """Return Optuna's distribution from which choices, as texts, are proposed."""
        from optuna.distributions import CategoricalDistribution

        return CategoricalDistribution([*map(flow_text, self.choices)])

    def stored(self, value: Any) -> str:
        """Return a value as Optuna stores it: as text, because Optuna's choices cannot be lists."""
        return flow_text(value)

    def value(self, stored: Any) -> Any:
        """Return the choice that Optuna stores as the text ``stored``."""
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
    """How trials are judged: the list of worlds on which their policies are evaluated, and how often in a training."""

    # Number of worlds of the list.
    worlds: int = Field(default=1000, ge=1, le=1_000_000, description="of the list")
    # Seed from which these worlds are drawn.
    seed: Seed = Field(default=4007, description="of the list")
    # Number of evaluations in the course of a training.
    times: int = Field(default=10, ge=1, le=1000, description="how often a training is measured")


class Pruning(FileModel):
    """Rule that stops weak trials early (Ray's median stopping rule).

    A trial (one training) stops if its least harm so far is above the median of the other trials' mean harm up to the
    same evaluation.
    """

    # Least number of other trials that must have reached the same evaluation before a trial may be stopped.
    after_trials: _Count = Field(default=5, description="so many others must have come as far before one is stopped")
    # Number of evaluations, apart from that before the training, that every trial is allowed to make.
    after_times: _Count = Field(default=3, description="nobody is stopped before it was measured so often")

    def rule(self) -> TrialScheduler:
        """Return Ray Tune's scheduler that applies this rule."""
        from ray.tune.schedulers import MedianStoppingRule

        return MedianStoppingRule(
            "training_iteration",
            HARM,
            "min",
            grace_period=self.after_times + 1,  # the first evaluation is of an untrained policy
            min_samples_required=self.after_trials,
            min_time_slice=math.inf,  # no trial waits for others
        )


class Sampling(FileModel):
    """How the values of the next trial are chosen: by Optuna's TPE from the results of earlier trials, or at random."""

    name: Literal["tpe", "random"] = Field(default="tpe", description="Optuna's TPE, or chance")
    # Seed of the proposed values.
    seed: Seed = Field(default=0, description="of what is proposed")
    # Number of first trials with random values, before TPE chooses.
    random_trials: _Count = Field(default=10, description="trials by chance before TPE begins")

    def of_trial(self, number: int) -> BaseSampler:
        """Return the Optuna sampler that proposes the values of trial ``number``; its seed depends on the number."""
        from optuna.samplers import RandomSampler, TPESampler

        seed = int(np.random.SeedSequence([self.seed, number]).generate_state(1)[0])
        if self.name == "random":
            return RandomSampler(seed=seed)
        return TPESampler(seed=seed, n_startup_trials=self.random_trials)


class TuningFile(StudyFile):
    """Content of the YAML file of a tuning: a training, and the settings of its recipe to search for the least harm."""

    scenario: str = Field(description="a name or a path, as train --scenario")
    recipe: str = Field(description="a name or a path, as train --recipe")
    seed: Seed = Field(default=0, description="of every training")
    settings: Annotated[dict[str, Any], AfterValidator(_check_recipe_keys)] = Field(
        default={}, alias="set", description="settings of every trial, as train --set"
    )
    search: Annotated[dict[str, Dimension], AfterValidator(_check_recipe_keys)] = Field(
        min_length=1, description="the space: a dotted key of the recipe, with a range or a list of choices"
    )
    measure: Measuring = Field(default=Measuring(), description="the list on which trials are judged, and how often")
    prune: Pruning | None = Field(default=Pruning(), description="when a trial is given up; null: never")
    sampler: Sampling = Field(default=Sampling(), description="who proposes")

    def values(self, proposal: Mapping[str, Any]) -> dict[str, Any]:
        """Return the values of a proposal as in a YAML file: key -> value.

        ``proposal`` maps each searched key to its value as Optuna stores it.
        """
        return {key: self.search[key].value(value) for key, value in proposal.items()}

    def space(self) -> dict[str, BaseDistribution]:
        """Return key -> Optuna's distribution of its values, for each searched key."""
        return {key: dimension.distribution() for key, dimension in self.search.items()}

    def points(self, number: int) -> Iterator[dict[str, Any]]:
        """Return ``number`` random points of the space, each as key -> value; the same ones each time."""
        with naming_extras():
            import optuna
        optuna.logging.set_verbosity(optuna.logging.WARNING)
        study = optuna.create_study(sampler=optuna.samplers.RandomSampler(seed=0))
        space = self.space()
        return (self.values(study.ask(space).params) for _ in range(number))


Values = Mapping[str, Any]  # values of a trial: key -> value in YAML's form

_NOT_SEARCHED = {  # key -> reason; also holds for keys inside it
    "seed": "a seed is luck; give one for all trials, as seed",
    "evaluation": "trials are judged on one list; give it as measure",
    "algorithm": "each algorithm has a recipe of its own; tune one at a time",
    "total_steps": "every trial gets the same number of decisions; give it in set",
    "checkpoint_every_updates": "it changes no result",
    "reward.harm_count": "it says which harm is least; give it in set",
}

PRUNED = "pruned: too much harm for so many decisions"

_TRIED = 200  # random points of the space that are checked before the search starts

TABLE, TRIALS, PROPOSALS = "trials.csv", "trials", "proposals.json"  # names inside the folder


@dataclass(frozen=True)
class TuningPlan:
    """A tuning, checked and loaded: everything that its trials have in common."""

    file: TuningFile  # content of the tuning's file
    recipe: TrainingRecipe  # recipe with the file's settings and seed, before any searched value
    scenario: Scenario  # scenario with the file's settings
    question: Mapping[str, Any]  # all settings and versions that a trial's harm depends on, as plain data

    @staticmethod
    def json_schema() -> dict[str, Any]:
        """Return the JSON Schema of a tuning's file, for editors that complete and check YAML."""
        return FileSchema.publish({**TuningFile.model_json_schema(), "title": "Tuning"})

    @classmethod
    def read(cls, path: str | Path) -> TuningPlan:
        """Read the file of a tuning, load its parts and check its space.

        Raises ``InvalidInput`` with file and line for: an unknown scenario or recipe, a key that the recipe does not
        have or that may not be searched, a value that the recipe does not allow, and values that do not go together.
        """
        file = TuningFile.read_as(path, "with scenario, recipe and search")
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
        asked = file.scenario, file.recipe, texts_of(file.settings)
        try:
            scenario, recipe = load_parts(*asked)
        except InvalidInput:
            part = refused_part(*asked)
            with at(("set", part) if part in file.settings else (part or "set",)):
                raise
        recipe = recipe.replace(seed=file.seed)
        with at(("scenario",)):
            content = Training.of(recipe, scenario).content()
        settings = {
            "training": content,
            **file.model_dump(mode="json", include={"search", "measure", "prune", "sampler"}),
            "order": [*file.search],
            "versions": installed_versions(),
        }
        plan = cls(file, recipe, scenario, settings)
        for key, dimension in file.search.items():
            with at(("search", key)):
                plan._check_dimension(key, dimension)
        points = [
            *({key: each.ends[end] for key, each in file.search.items()} for end in (0, -1)),
            *file.points(_TRIED),
        ]
        with at(("search",)):
            for point in points:
                plan._check_point(point)
        return plan

    def training(self, values: Values) -> Training:
        """Return the training of a trial with these values of the searched keys.

        It is evaluated as often as the file's ``measure.times`` says, so that all trials can be compared on the way.
        Raises ``InvalidInput`` if the values do not go together.
        """
        recipe = read_settings(texts_of(values), [self.recipe]).change(self.recipe)
        asked = self.file.measure
        every = -(-self.updates(recipe) // asked.times)
        listed = {"every_updates": every, "worlds": asked.worlds, "seed": asked.seed}
        return Training.of(recipe.replace(evaluation=listed), self.scenario)

    def updates(self, recipe: TrainingRecipe) -> int:
        """Return the number of updates of a whole training by this recipe."""
        return -(-recipe.total_steps // (recipe.n_envs * len(self.scenario.learners) * recipe.rounds))

    def own_values(self) -> dict[str, Any] | None:
        """Return the recipe's own value of each searched key; None if one of them is not in the space."""
        content = self.recipe.model_dump(mode="json")
        own = {key: dimension.own(_value_at(content, key)) for key, dimension in self.file.search.items()}
        return None if None in own.values() else own

    def example(self) -> str:
        """Return a command line ``ethbrake train ...`` that trains the same as one of the trials.

        It is the first trial if the space contains the recipe's own values, else one with random values.
        """
        values = self.own_values() or next(self.file.points(1))
        measured = {"evaluation": self.training(values).recipe.evaluation.model_dump(mode="json")}
        words = ["ethbrake", "train", "--scenario", self.file.scenario, "--recipe", self.file.recipe]
        words += ["--seed", str(self.file.seed)]
        for text in texts_of({**self.file.settings, **values, **measured}):
            words += ["--set", text]
        return shlex.join(words)

    def _check_dimension(self, key: str, dimension: Range | Choices) -> None:
        own = _value_at(self.recipe.model_dump(mode="json"), key)
        if isinstance(dimension, Range) and not dimension.whole and type(own) is int:
            try:
                self.training({key: math.nextafter(dimension.low, math.inf)})
            except InvalidInput:
                written = f"{{low: {dimension.low!r}, high: {dimension.high!r}}}"  # as written, with decimal points
                right = "must be whole numbers, written without a decimal point"
                raise InvalidInput(f"search.{key} = {written}: {right}") from None
        for value in dimension.ends:
            self._check_point({key: value})

    def _check_point(self, values: Values) -> None:
        try:
            self.training(values)
        except InvalidInput as error:
            raise InvalidInput(f"search, at {', '.join(texts_of(values))}: {error}") from None

    def folder(self, path: Path) -> StudyFolder:
        """Return the object that checks and locks the folder ``path``, which may belong to this tuning only."""
        return StudyFolder(path, "a tuning", self.question, record="tuning.json", writes=(TABLE,))

    def proposals(self, path: Path) -> list[Values]:
        """Return the proposals (values of each trial so far) in the tuning's folder ``path``, as Optuna stores them.

        Raises ``InvalidInput`` if one has other keys or values than the file's ``search`` allows.
        """
        file, space = path / PROPOSALS, self.file.search
        if not file.exists():
            return []
        known: Any = read_object(file).get("trials")
        try:
            for proposal in known:
                values = self.file.values(proposal)
                if values.keys() != space.keys() or None in (space[key].own(value) for key, value in values.items()):
                    raise ValueError
        except (TypeError, ValueError, AttributeError, LookupError):
            raise InvalidInput(f"{file}: is damaged: a trial has other keys or values than the space") from None
        return [*known]

    def job(self, values: Values, path: Path) -> TrainingJob:
        """Return the training of a trial with these values, with its folder inside the tuning's folder ``path``.

        Trials with equal values share one training.
        """
        training = self.training(values)
        return TrainingJob(training, path / TRIALS / training.identity[:16], texts_of({**self.file.settings, **values}))

    def run(
        self,
        path: Path,
        trials: int,
        *,
        jobs: int = 1,
        ray: str = LOCAL,
        retries: int = 2,
        tell: OnProgress | None = None,
    ) -> TuningResult:
        """Run trials until the folder has ``trials`` of them, and write their table, also after Ctrl-C.

        The search starts over each time with the stored proposals: a finished training is read from its folder, and an
        unfinished one continues.

        Args:
            path: folder of all results; created if needed.
            trials: number of trials that the folder has at the end.
            jobs: trials at once; more than one changes the proposals.
            ray: address of a Ray cluster; ``local``: only this machine.
            retries: further attempts at a trial whose process was lost.
            tell: called with the number of ended trials, and reasons of failures.

        Raises ``InvalidInput`` if another process works in the folder, for a damaged file, or if there is no cluster.

        """
        with self.folder(path).work():
            (path / TRIALS).mkdir(exist_ok=True)
            remove_unfinished(path / TRIALS)
            known = self.proposals(path)
            with connected(ray, jobs):
                proposed, ends = self._search(path, known, trials, jobs, retries, tell)
            records = [
                Trial.of(number, self.file.values(values), end)
                for number, (values, end) in enumerate(zip(proposed, ends, strict=False))
            ]
            rows = [
                {
                    "trial": each.number,
                    "state": each.state,
                    "hash": self.training(each.values).identity,
                    **{key: flow_text(value) for key, value in each.values.items()},
                    **each.figures,
                    "reason": each.reason,
                }
                for each in records
                if each.state != "running"
            ]
            columns = ["trial", "state", "hash", *self.file.search, *FIGURES, "reason"]
            write_file(path / TABLE, csv_text(rows, columns).encode())
        return TuningResult(path / TABLE, max(trials, len(proposed)), tuple(records))

    def _search(
        self, path: Path, known: list[Values], trials: int, jobs: int, retries: int, tell: OnProgress | None
    ) -> tuple[list[Values], list[dict[str, Any]]]:
        """Run the trials on Ray, and return all proposals and the last report of each of their trials.

        ``known`` are the proposals of earlier runs; the other arguments are those of ``run``.
        """
        from ray import tune

        from ethbrake_marl.extensions.studies.proposals import Proposals
        from ethbrake_marl.extensions.studies.trials import TrialCallback, run_trials

        own = self.own_values()
        first = None if own is None else {key: self.file.search[key].stored(value) for key, value in own.items()}
        search = Proposals(path / PROPOSALS, known, self.file.space(), self.file.sampler.of_trial, first)
        total, prune = max(trials, len(known)), self.file.prune
        callback = TrialCallback("tuning", 0, total, tell)
        if known:
            callback.say(f"{count_of(len(known), 'trial')} begun before: what ended is kept, the rest goes on")
        elif own is None:
            callback.say("the recipe's own values are not in the space, so no trial has them")
        ends = run_trials(
            do_trial,
            {"plan": self, "path": path.absolute()},
            path,
            tune.TuneConfig(search_alg=search, num_samples=total, scheduler=prune and prune.rule()),
            {},
            jobs=jobs,
            retries=retries,
            callback=callback,
        )
        return search.known, ends

    def best_recipe(self, values: Values, file: Path, source: str) -> str:
        """Return the YAML text of a recipe that repeats the training with these values.

        Args:
            values: value of each searched key.
            file: path that the text will be written to; its name becomes the recipe's.
            source: text for the recipe's key ``source``.

        Raises ``InvalidInput`` if the file's name is not a valid name of a recipe.

        """
        check_file_name("recipe", file.stem)
        described = f"Settings of {self.file.recipe} that `ethbrake study tune` found."
        recipe = self.training(values).recipe.replace(
            name=file.stem, title=self.file.title, description=described, source=source
        )
        parts = {*type(self.recipe).model_fields, "recipe"}
        of_scenario = {  # settings of the scenario, which a recipe does not have
            key: value
            for key, value in self.file.settings.items()
            if key.startswith("scenario.") or key.partition(".")[0] not in parts
        }
        settings = "".join(f" --set {text}" for text in texts_of(of_scenario))
        command = f"ethbrake train --scenario {self.file.scenario}{settings} --recipe {file.name}"
        return recipe.text(f"# The best trial of a tuning, trained again: {command}\n")

    def has_exported(self, path: Path, file: Path) -> bool:
        """Return whether ``file`` is the exported recipe of one of the trials in the tuning's folder ``path``."""
        try:
            source, text = load_recipe(file).source, file.read_text("utf-8")
        except InvalidInput:
            return False
        values = map(self.file.values, self.proposals(path))
        return any(self.best_recipe(each, file, source) == text for each in values)


State = Literal["running", "finished", "pruned", "failed"]


@dataclass(frozen=True, slots=True)
class Trial:
    """One trial of a tuning (a training with some values of the searched keys), and how it ended."""

    number: int  # number of the trial, from 0
    state: State  # how it ended; ``pruned``: stopped early because of too much harm
    values: Values  # value of each searched key
    harm: float | None  # harm of its best policy on the tuning's list (m2/s2); None unless finished
    figures: Mapping[str, Any]  # entries for the table (``FIGURES``) at its end, or when it was pruned
    reason: str  # reason of a failure; else empty

    @classmethod
    def of(cls, number: int, values: Values, end: Mapping[str, Any]) -> Trial:
        """Return the trial ``number`` with these values, from its last report ``end`` (see ``run_trials``)."""
        reason = str(end.get(REASON, ""))
        state: State = "running"
        if reason:
            state = "failed"
        elif end.get("done"):
            state = "finished" if "policy_sha256" in end else "pruned"
        figures = {name: end[name] for name in FIGURES if name in end and not reason}
        return cls(number, state, values, end[HARM] if state == "finished" else None, figures, reason)


@dataclass(frozen=True, slots=True)
class TuningResult:
    """Trials after a run of a tuning, and the file of their table."""

    table: Path  # CSV file with a row for each trial that ended
    asked: int  # number of trials that the folder should have at the end
    trials: tuple[Trial, ...]  # trials that were begun, in order

    @property
    def counts(self) -> Counter[State]:
        """State (``finished``, ``pruned``, ...) -> number of trials in it."""
        return Counter(each.state for each in self.trials)

    @property
    def interrupted(self) -> bool:
        """Whether some of the requested trials did not end, because Ctrl-C stopped the run."""
        return len(self.trials) < self.asked or "running" in self.counts

    @property
    def best(self) -> Trial | None:
        """The finished trial with the least harm; of equal ones the first. None if no trial has finished."""
        finished = [each for each in self.trials if each.harm is not None]
        return min(finished, key=lambda each: (each.harm, each.number), default=None)


def do_trial(config: dict[str, Any], plan: TuningPlan, path: Path) -> None:
    """Train one trial to its end, in a worker process of Ray, and report every evaluation.

    Ray stops a pruned trial at such a report.

    Args:
        config: ``{"trial": number, "values": proposal}``, values as Optuna stores them.
        plan: the tuning.
        path: folder of the tuning.

    """
    from ray.tune import report

    job = plan.job(plan.file.values(config["values"]), path)
    evaluations: list[Evaluation] = []
    last = plan.updates(job.training.recipe) * job.per_update

    def judge(evaluation: Evaluation) -> None:
        if evaluations and evaluation["steps"] <= evaluations[-1]["steps"]:
            return  # the same evaluation again, after an interruption
        evaluations.append(evaluation)
        if evaluation["steps"] < last:
            report(figures(job, evaluations))

    def stop_at(evaluation: Evaluation) -> str | None:
        try:
            judge(evaluation)
        except SystemExit:  # Ray's way to end a trial; first let the training close its folder
            return PRUNED
        return None

    for evaluation in evaluations_of(job):
        judge(evaluation)
    if not finish(job, stop_at):
        raise SystemExit
    report(final_figures(job))


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
    """Return the value at a dotted key (``network.policy.0``) of the nested data ``content``; None if there is none."""
    for part in key.removeprefix("recipe.").split("."):
        if isinstance(content, list) and part.isdecimal() and int(part) < len(content):
            content = content[int(part)]
        elif isinstance(content, Mapping):
            content = content.get(part)
        else:
            return None
    return content
