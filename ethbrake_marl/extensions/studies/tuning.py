"""A tuning: search with Optuna, on Ray Tune, for settings of a recipe that lead to little harm, and write a table.

The table contains no times and no paths. If only one trial runs at a time, the table is the same, byte for byte,
however often the search was interrupted.

Arguments that several methods share: ``values`` has a value for each searched key. ``path`` is the folder of the
tuning's results (in ``TuningPlan.read``: the YAML file that describes the tuning).
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
    """Return ``value`` if it is a finite number, else raise ``ValueError``; an ``int`` stays an ``int``."""
    if not isinstance(value, int | float) or isinstance(value, bool) or not math.isfinite(value):
        raise ValueError("each end of a range must be a finite number")
    return value


_Number = Annotated[int | float, PlainValidator(_check_number), WithJsonSchema({"type": "number"})]


class Range(FileModel):
    """Range of the numbers that a search may try for one setting, from ``low`` to ``high`` inclusive.

    If ``low`` and ``high`` are written without a decimal point, the search tries only whole numbers.
    """

    low: _Number = Field(description="smallest value to try")
    high: _Number = Field(
        description="largest value to try; if low and high have no decimal point, only whole numbers are tried"
    )
    log: bool = Field(default=False, description="true: values are spread evenly on a logarithmic scale")

    def __str__(self) -> str:
        """Return text such as ``from 0.001 to 0.1, logarithmic``."""
        kind = ", whole numbers" * self.whole + ", logarithmic" * self.log
        return f"from {flow_text(self.low)} to {flow_text(self.high)}{kind}"

    @property
    def whole(self) -> bool:
        """Whether only whole numbers are tried."""
        return isinstance(self.low, int) and isinstance(self.high, int)

    @model_validator(mode="after")
    def _in_order(self) -> Range:
        if not self.low < self.high:
            raise ValueError(f"low ({flow_text(self.low)}) must be less than high ({flow_text(self.high)})")
        if self.log and not self.low > 0:
            raise ValueError(f"low ({flow_text(self.low)}) must be above 0, because log is true")
        return self

    @property
    def ends(self) -> tuple[Any, ...]:
        """The smallest and the largest value; before the search starts, the recipe is checked with each of them."""
        return self.low, self.high

    def own(self, value: Any) -> int | float | None:
        """Return ``value``, the recipe's own value of this setting, as a number; None if it is outside the range."""
        if not isinstance(value, int | float) or isinstance(value, bool) or not self.low <= value <= self.high:
            return None
        if not self.whole:
            return float(value)
        return int(value) if value == int(value) else None

    def distribution(self) -> BaseDistribution:
        from optuna.distributions import FloatDistribution, IntDistribution

        if self.whole:
            return IntDistribution(int(self.low), int(self.high), log=self.log)
        return FloatDistribution(float(self.low), float(self.high), log=self.log)

    def stored(self, value: Any) -> Any:
        """Return ``value`` unchanged, because Optuna stores a number of a range as the number itself."""
        return value

    value = stored


class Choices(FileModel):
    """List of the values that a search may try for one setting. The values may be numbers, texts, lists or mappings."""

    choices: tuple[Any, ...] = Field(
        strict=False, min_length=2, description="values to try, of any kind that the recipe accepts for this key"
    )

    def __str__(self) -> str:
        """Return text such as ``one of relu, tanh``."""
        return f"one of {', '.join(map(flow_text, self.choices))}"

    @model_validator(mode="after")
    def _once_each(self) -> Choices:
        texts = [*map(flow_text, self.choices)]
        twice = [text for k, text in enumerate(texts) if text in texts[:k]]
        if twice:
            raise ValueError(f"the value {twice[0]} is listed twice; list each value once")
        return self

    @property
    def ends(self) -> tuple[Any, ...]:
        """All choices; before the search starts, the recipe is checked with each of them."""
        return self.choices

    def own(self, value: Any) -> Any:
        """Return the choice that equals the recipe's own ``value`` of this setting; None if no choice equals it."""
        return next((each for each in self.choices if flow_text(each) == flow_text(value)), None)

    def distribution(self) -> BaseDistribution:
        """Return Optuna's distribution of the choices, which are stored as texts."""
        from optuna.distributions import CategoricalDistribution

        return CategoricalDistribution([*map(flow_text, self.choices)])

    def stored(self, value: Any) -> str:
        """Return ``value`` as Optuna stores it: as text, because Optuna cannot store lists."""
        return flow_text(value)

    def value(self, stored: Any) -> Any:
        """Return the choice whose text, as Optuna stores it, is ``stored``."""
        return {flow_text(value): value for value in self.choices}[stored]


def _form(value: Any) -> str:
    return "#choices" if isinstance(value, Choices) or (isinstance(value, dict) and "choices" in value) else "#range"


Dimension = Annotated[Annotated[Range, Tag("#range")] | Annotated[Choices, Tag("#choices")], Discriminator(_form)]


def _check_recipe_keys(value: dict[str, Any]) -> dict[str, Any]:
    for key in value:
        if not key or "=" in key:
            raise ValueError(f"{flow_text(key, 60)}: not a key of the recipe; give a key such as learning_rate.start")
    return value


class Measuring(FileModel):
    """How trials are evaluated: the worlds that the policies drive, and the number of evaluations per training run."""

    # Number of worlds in which the policies are evaluated.
    worlds: int = Field(
        default=1000, ge=1, le=1_000_000, description="number of worlds in which the policies are evaluated"
    )
    # Seed from which the worlds are drawn.
    seed: Seed = Field(default=4007, description="seed from which the worlds are drawn")
    # Number of evaluations during a training run.
    times: int = Field(default=10, ge=1, le=1000, description="number of evaluations during a training run")


class Pruning(FileModel):
    """Rule that stops weak trials early (Ray's median stopping rule).

    A trial is one training run with several evaluations. After the k-th evaluation of a trial, the rule computes the
    mean harm of each other trial over the first k evaluations. The trial is stopped if its own least harm so far is
    above the median of the mean harms of the other trials.
    """

    # Number of other trials that must have reached an evaluation before a trial may be stopped there.
    after_trials: _Count = Field(
        default=5, description="number of other trials that must have reached an evaluation before a trial is stopped"
    )
    # Number of evaluations that every trial completes, not counting the evaluation before the training.
    after_times: _Count = Field(
        default=3, description="number of evaluations that each trial completes before it may be stopped"
    )

    def rule(self) -> TrialScheduler:
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
    """Method that chooses the values of the next trial: random choice, or Optuna's TPE, which uses earlier results."""

    name: Literal["tpe", "random"] = Field(default="tpe", description="tpe: Optuna's TPE; random: random values")
    # Seed of the proposed values.
    seed: Seed = Field(default=0, description="seed of the proposed values")
    # Number of first trials with random values, before TPE chooses.
    random_trials: _Count = Field(default=10, description="number of trials with random values before TPE begins")

    def of_trial(self, number: int) -> BaseSampler:
        """Return the Optuna sampler for trial ``number``; its seed depends on the number."""
        from optuna.samplers import RandomSampler, TPESampler

        seed = int(np.random.SeedSequence([self.seed, number]).generate_state(1)[0])
        if self.name == "random":
            return RandomSampler(seed=seed)
        return TPESampler(seed=seed, n_startup_trials=self.random_trials)


class TuningFile(StudyFile):
    """Content of the YAML file of a tuning: scenario and recipe of all training runs, and the settings to search."""

    scenario: str = Field(description="name or path of the scenario, as in ethbrake train --scenario")
    recipe: str = Field(description="name or path of the recipe, as in ethbrake train --recipe")
    seed: Seed = Field(default=0, description="seed of every training run")
    settings: Annotated[dict[str, Any], AfterValidator(_check_recipe_keys)] = Field(
        default={}, alias="set", description="settings of every trial, as in ethbrake train --set"
    )
    search: Annotated[dict[str, Dimension], AfterValidator(_check_recipe_keys)] = Field(
        min_length=1,
        description="keys of the recipe to search (for instance learning_rate.start), with a range or list of choices",
    )
    measure: Measuring = Field(
        default=Measuring(), description="how trials are evaluated: worlds, and number of evaluations"
    )
    prune: Pruning | None = Field(
        default=Pruning(), description="rule that stops weak trials early; null: no trial is stopped"
    )
    sampler: Sampling = Field(default=Sampling(), description="method that chooses the values of the next trial")

    def values(self, proposal: Mapping[str, Any]) -> dict[str, Any]:
        """Convert a proposal (values as Optuna stores them) into values as in the YAML file of a recipe."""
        return {key: self.search[key].value(value) for key, value in proposal.items()}

    def space(self) -> dict[str, BaseDistribution]:
        """Return Optuna's distribution of each searched key."""
        return {key: dimension.distribution() for key, dimension in self.search.items()}

    def points(self, number: int) -> Iterator[dict[str, Any]]:
        """Yield ``number`` random combinations of values, the same in every call."""
        with naming_extras():
            import optuna
        optuna.logging.set_verbosity(optuna.logging.WARNING)
        study = optuna.create_study(sampler=optuna.samplers.RandomSampler(seed=0))
        space = self.space()
        return (self.values(study.ask(space).params) for _ in range(number))


Values = Mapping[str, Any]  # values of a trial: key -> value in YAML's form

_NOT_SEARCHED = {  # key (or first part of a key) that cannot be searched -> reason
    "seed": "a good seed is luck; give one seed for all trials, as the key seed",
    "evaluation": "all trials are evaluated on the same list; describe it with the key measure",
    "algorithm": "a recipe has the keys of one algorithm; tune each algorithm in a file of its own",
    "total_steps": "all trials have the same number of decisions; give it under set",
    "checkpoint_every_updates": "it has no effect on the result",
    "reward.harm_count": "it defines the harm that the tuning minimises; give it under set",
}

PRUNED = "pruned: more harm than other trials after the same number of decisions"

_TRIED = 200  # random points of the space that are checked before the search starts

TABLE, TRIALS, PROPOSALS = "trials.csv", "trials", "proposals.json"  # names inside the folder


@dataclass(frozen=True)
class TuningPlan:
    """Checked content of a tuning's file, with the scenario and the recipe that all trials share."""

    file: TuningFile  # content of the tuning's file
    recipe: TrainingRecipe  # recipe with the file's settings and seed, before any searched value
    scenario: Scenario  # scenario with the file's settings
    question: Mapping[str, Any]  # all settings and versions that a trial's harm depends on, as plain data

    @staticmethod
    def json_schema() -> dict[str, Any]:
        """Return the JSON Schema of a tuning file, for editors."""
        return FileSchema.publish({**TuningFile.model_json_schema(), "title": "Tuning"})

    @classmethod
    def read(cls, path: str | Path) -> TuningPlan:
        """Read the file of a tuning, load the scenario and the recipe, and check the searched keys and values.

        Raises ``InvalidInput``, with file and line, if the scenario, the recipe or a key is unknown, if a key may not
        be searched, if the recipe does not allow a value, or if the recipe does not allow some values together.
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
                    raise InvalidInput(
                        f"set.{key}: this key is not allowed under set; to choose the seed and the evaluation, write"
                        " the keys seed and measure at the top of the file"
                    )
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
        """Return the training run of the trial with these ``values``.

        Every training run has about ``measure.times`` evaluations, so that trials can be compared before they finish.
        Raises ``InvalidInput`` if the recipe does not allow this combination of values.
        """
        recipe = read_settings(texts_of(values), [self.recipe]).change(self.recipe)
        asked = self.file.measure
        every = -(-self.updates(recipe) // asked.times)
        listed = {"every_updates": every, "worlds": asked.worlds, "seed": asked.seed}
        return Training.of(recipe.replace(evaluation=listed), self.scenario)

    def updates(self, recipe: TrainingRecipe) -> int:
        """Return the number of policy updates in a complete training run with ``recipe``."""
        return -(-recipe.total_steps // (recipe.n_envs * len(self.scenario.learners) * recipe.rounds))

    def own_values(self) -> dict[str, Any] | None:
        """Return the recipe's own value of each searched key; None if any of them is not among the values to search."""
        content = self.recipe.model_dump(mode="json")
        own = {key: dimension.own(_value_at(content, key)) for key, dimension in self.file.search.items()}
        return None if None in own.values() else own

    def example(self) -> str:
        """Return a command line ``ethbrake train ...`` that does the same training run as one trial.

        Every searched key gets the recipe's own value or, if one of these values is not to be searched, a random value.
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
            raise InvalidInput(f"search: a trial with {', '.join(texts_of(values))} is not possible: {error}") from None

    def folder(self, path: Path) -> StudyFolder:
        """Return a ``StudyFolder``, which raises ``InvalidInput`` for the folder of a tuning with other settings."""
        return StudyFolder(path, "a tuning", self.question, record="tuning.json", writes=(TABLE,))

    def proposals(self, path: Path) -> list[Values]:
        """Return the stored proposals: the values of each trial so far, as Optuna stores them.

        Raises ``InvalidInput`` if the entry ``search`` of the tuning's file does not allow a proposal.
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
            raise InvalidInput(
                f"{file}: the file is damaged: a trial has keys or values that are not in the search space; delete the"
                " folder to start again"
            ) from None
        return [*known]

    def job(self, values: Values, path: Path) -> TrainingJob:
        """Return the training run with these ``values``, and its folder; trials with equal values share both."""
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
        """Run trials until the folder contains ``trials`` trials, and write a table of the trials that ended.

        Every run repeats the search from the first trial, with the stored proposals of earlier runs. The results of
        finished trials are read from their folders. Unfinished trials continue. The table is also written if Ctrl-C
        stops the run. Raises ``InvalidInput`` if another process works in the folder, if a file is damaged, or if no
        cluster runs at the address ``ray``.

        Args:
            path: folder of all results; created if necessary.
            trials: number of trials in the folder at the end, including earlier runs.
            jobs: number of trials that run at once; this number affects the proposals.
            ray: address of a Ray cluster; ``local``: Ray is started on this machine.
            retries: number of times that a trial is started again after its process ended unexpectedly.
            tell: called with the number of trials that have ended, and with the reason of each failure.

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
        """Run the trials on Ray; return all proposals, and the last result that each trial reported.

        ``known`` are the proposals of earlier runs.
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
            callback.say(f"{count_of(len(known), 'trial')} begun in earlier runs; unfinished trials continue")
        elif own is None:
            callback.say("no trial has the recipe's own values, because the ranges exclude them")
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
        """Return the YAML text of a recipe that repeats the training run of the trial with these ``values``.

        The name of ``file`` becomes the name of the recipe; ``source`` is the recipe's key ``source``. Raises
        ``InvalidInput`` if the name of ``file`` is not a valid name of a recipe.
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
        """Return whether ``file`` is a recipe that was exported from a trial in the folder ``path``."""
        try:
            source, text = load_recipe(file).source, file.read_text("utf-8")
        except InvalidInput:
            return False
        values = map(self.file.values, self.proposals(path))
        return any(self.best_recipe(each, file, source) == text for each in values)


State = Literal["running", "finished", "pruned", "failed"]


@dataclass(frozen=True, slots=True)
class Trial:
    """One trial of a tuning: one training run, and its result."""

    number: int  # number of the trial, from 0
    state: State  # state of the trial; ``pruned``: stopped early because of too much harm
    values: Values  # value of each searched key
    harm: float | None  # harm of the best policy on the tuning's list (m2/s2); None unless the trial has finished
    figures: Mapping[str, Any]  # entries of the table (``FIGURES``) at the end of the trial, or when it was pruned
    reason: str  # reason of a failure; else empty

    @classmethod
    def of(cls, number: int, values: Values, end: Mapping[str, Any]) -> Trial:
        """Return a trial; ``end`` is the last result that it reported to Ray (see ``run_trials``)."""
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
    """Result of ``TuningPlan.run``."""

    table: Path  # CSV file with a row for each trial that ended
    asked: int  # requested number of trials in the folder
    trials: tuple[Trial, ...]  # trials that have begun, in order

    @property
    def counts(self) -> Counter[State]:
        """Number of trials in each state (``finished``, ``pruned``, ...)."""
        return Counter(each.state for each in self.trials)

    @property
    def interrupted(self) -> bool:
        """Whether Ctrl-C stopped the tuning before all requested trials had ended."""
        return len(self.trials) < self.asked or "running" in self.counts

    @property
    def best(self) -> Trial | None:
        """Finished trial with the least harm, the first one if several have it; None if no trial has finished."""
        finished = [each for each in self.trials if each.harm is not None]
        return min(finished, key=lambda each: (each.harm, each.number), default=None)


def do_trial(config: dict[str, Any], plan: TuningPlan, path: Path) -> None:
    """Train the policy of one trial in a worker process of Ray, and report every evaluation to Ray, which may prune it.

    ``config`` is ``{"trial": number, "values": proposal}``.
    """
    from ray.tune import report

    job = plan.job(plan.file.values(config["values"]), path)
    evaluations: list[Evaluation] = []
    last = plan.updates(job.training.recipe) * job.per_update

    def judge(evaluation: Evaluation) -> None:
        if evaluations and evaluation["steps"] <= evaluations[-1]["steps"]:
            return  # this evaluation was already reported before an interruption
        evaluations.append(evaluation)
        if evaluation["steps"] < last:
            report(figures(job, evaluations))

    def stop_at(evaluation: Evaluation) -> str | None:
        try:
            judge(evaluation)
        except SystemExit:  # Ray ends a trial with this exception; the training must close its folder first
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
            raise InvalidInput(f"search.{key}: this key cannot be searched: {reason}")
    for other in (*file.settings, *(each for each in file.search if each != key)):
        if f"{bare}.".startswith(f"{other.removeprefix('recipe.')}."):
            raise InvalidInput(f"search.{key}: the file also sets {other}; delete one of the two keys")
    if read_settings([f"{key}=0"], [recipe]).scenario:
        raise InvalidInput(
            f"search.{key}: this is a key of the scenario, but only keys of the recipe can be searched, because harms"
            " can be compared only in the same scenario"
        )


def _value_at(content: Any, key: str) -> Any:
    """Return the value of a dotted key (``network.policy.0``) in nested data; None if the key is missing."""
    for part in key.removeprefix("recipe.").split("."):
        if isinstance(content, list) and part.isdecimal() and int(part) < len(content):
            content = content[int(part)]
        elif isinstance(content, Mapping):
            content = content.get(part)
        else:
            return None
    return content
