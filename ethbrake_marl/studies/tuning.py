"""Run a tuning: trials that ended are kept, those that were begun go on, new ones are asked for as there is room."""

from __future__ import annotations

import csv
import io
import json
import uuid
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from ethbrake_marl.errors import InvalidInput, count_of, describe_error, naming_extras
from ethbrake_marl.files.store import hold_lock, remove_unfinished, write_file
from ethbrake_marl.files.yaml import flow_text
from ethbrake_marl.learning.progress import HARM_METRIC, OBJECTIVE
from ethbrake_marl.learning.recipe import recipe_text
from ethbrake_marl.learning.training import RunDirectory, read_object
from ethbrake_marl.policies.actor import installed_versions
from ethbrake_marl.scenario.schema import check_file_name
from ethbrake_marl.studies.jobs import RETRIES, Attempt, Workers, pack, run_jobs
from ethbrake_marl.studies.sweep import RESULTS, do_job, read_results, reason_of
from ethbrake_marl.studies.trainings import TrainingJob, time_training, training_seconds
from ethbrake_marl.studies.tuning_file import (
    Choices,
    Pruning,
    Range,
    Sampling,
    TuningFile,
    TuningPlan,
    Values,
    texts_of,
)

if TYPE_CHECKING:
    from optuna import Trial
    from optuna.distributions import BaseDistribution
    from optuna.pruners import BasePruner
    from optuna.samplers import BaseSampler
    from optuna.storages import BaseStorage
    from optuna.trial import FrozenTrial


# The study in Optuna's storage: proposals, what was measured on the way, and ends. Nothing else knows Optuna.
#
# Trials are proposed by a sampler that is made anew for each, of the file's seed and the trial's number: what is
# proposed
# depends on what had ended by then, and not on how often the command was stopped in between.

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
    values: dict[str, Any] | None  # as YAML has them; None where it was killed while it was asked for
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
        optuna.logging.set_verbosity(optuna.logging.WARNING)
        self._place, self._search, self._sampling = place, place.file.search, place.file.sampler
        try:
            self._study = optuna.create_study(
                storage=_open_storage(place),
                study_name=f"ethbrake-{place.identity[:_DIGITS]}",
                pruner=_pruner(place.file.prune),
                direction="minimize",
                load_if_exists=True,
            )
        except Exception as error:  # whatever the driver of a database raises
            raise InvalidInput(f"storage {place}: cannot be used ({describe_error(error)})") from None

    def trials(self) -> list[TrialRecord]:
        """Every trial, by its number."""
        return sorted(map(self._record, self._all()), key=lambda each: each.number)

    def trial(self, number: int) -> TrialRecord:
        """One of them."""
        return self._record(self._frozen(number))

    def ask(self, owner: str) -> int:
        """Propose a trial, and give its number."""
        trial = self._study.ask()
        trial.set_user_attr(_OWNER, owner)
        self._study.sampler = _sampler(self._sampling, trial.number)
        for key, dimension in self._search.items():
            trial._suggest(key, _distribution(dimension))  # what suggest_float and its like call
        return trial.number

    def enqueue(self, values: Values) -> None:
        """Let the next proposal be this one, unless some trial has these values already."""
        stored = {key: _stored(self._search[key], value) for key, value in values.items()}
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

    def finish(self, number: int, harm: float, results: Sequence[str]) -> None:
        """End a trial that came to its end."""
        self._running(number).set_user_attr(_RESULTS, json.dumps(list(results)))
        self._study.tell(number, harm)

    def prune(self, number: int, results: Sequence[str]) -> None:
        """End a trial that was pruned."""
        from optuna.trial import TrialState

        self._running(number).set_user_attr(_RESULTS, json.dumps(list(results)))
        self._study.tell(number, state=TrialState.PRUNED)

    def fail(self, number: int, reason: str) -> None:
        """End a trial that failed."""
        from optuna.trial import TrialState

        self._running(number).set_user_attr(_REASON, reason)
        self._study.tell(number, state=TrialState.FAIL)

    def _all(self) -> list[FrozenTrial]:
        return self._study.get_trials(deepcopy=False)

    def _frozen(self, number: int) -> FrozenTrial:
        return next(each for each in self._all() if each.number == number)

    def _running(self, number: int) -> Trial:
        """A trial that another call, or another process, has asked for."""
        import optuna

        return optuna.Trial(self._study, self._frozen(number)._trial_id)

    def _record(self, trial: FrozenTrial) -> TrialRecord:
        note, state = trial.user_attrs, _STATES[trial.state.name]
        try:
            results = tuple(str(each) for each in json.loads(note.get(_RESULTS, "[]")))
            values = self._values(trial)
        except (ValueError, TypeError, LookupError) as error:
            raise InvalidInput(f"storage {self._place}: trial {trial.number} is damaged ({error})") from None
        owner, identity, reason = (str(note.get(what, "")) for what in (_OWNER, _HASH, _REASON))
        harm = trial.value if state == "finished" else None
        return TrialRecord(trial.number, state, values, owner, identity, harm, results, reason)

    def _values(self, trial: FrozenTrial) -> dict[str, Any] | None:
        if trial.params.keys() != self._search.keys():
            return None
        return {key: _value(dimension, trial.params[key]) for key, dimension in self._search.items()}


def mend_journal(journal: Path) -> None:
    """Take off a last line that was not written to its end; Optuna would read nothing once another line follows it."""
    if not journal.is_file():
        return
    content = journal.read_bytes()
    whole = content.rfind(b"\n") + 1
    if whole < len(content):
        with journal.open("r+b") as file:
            file.truncate(whole)


def _open_storage(place: Place) -> BaseStorage:
    from optuna.storages import JournalStorage, RDBStorage
    from optuna.storages.journal import JournalFileBackend

    return JournalStorage(JournalFileBackend(place.storage)) if place.private else RDBStorage(place.storage)


def _sampler(asked: Sampling, number: int) -> BaseSampler:
    from optuna.samplers import RandomSampler, TPESampler

    seed = int(np.random.SeedSequence([asked.seed, number]).generate_state(1)[0])
    if asked.name == "random":
        return RandomSampler(seed=seed)
    return TPESampler(seed=seed, n_startup_trials=asked.random_trials)


def _pruner(asked: Pruning | None) -> BasePruner:
    from optuna.pruners import NopPruner, PercentilePruner

    if asked is None:
        return NopPruner()
    return PercentilePruner(100.0 * asked.keep, n_startup_trials=asked.after_trials, n_warmup_steps=asked.after_times)


def _distribution(dimension: Range | Choices) -> BaseDistribution:
    from optuna.distributions import CategoricalDistribution, FloatDistribution, IntDistribution

    if isinstance(dimension, Choices):
        return CategoricalDistribution([flow_text(value) for value in dimension.choices])
    if dimension.whole:
        return IntDistribution(int(dimension.low), int(dimension.high), log=dimension.log)
    return FloatDistribution(float(dimension.low), float(dimension.high), log=dimension.log)


def _stored(dimension: Range | Choices, value: Any) -> Any:
    """A value as the storage has it: of a choice its text, for a storage keeps no lists."""
    return flow_text(value) if isinstance(dimension, Choices) else value


def _value(dimension: Range | Choices, stored: Any) -> Any:
    if isinstance(dimension, Choices):
        return {flow_text(value): value for value in dimension.choices}[stored]
    return int(stored) if dimension.whole else float(stored)


# One trial, wherever it runs: train, tell the study every measurement, and stop where the study would not go on.

PRUNED = "pruned: too much harm for so many decisions"


@dataclass(frozen=True, slots=True)
class TrialJob:
    """A trial that was asked for, and its training."""

    training: TrainingJob
    place: Place
    number: int  # of the trial
    times: int  # measurements of a whole training
    updates: int  # of a whole training


@dataclass(frozen=True, slots=True)
class TrialEnd:
    """What came of a trial."""

    pruned: bool
    results: tuple[str, ...]  # the values of a sweep's ``RESULTS``

    def harm(self, training_harm: str) -> float:
        """Least harm on the tuning's list, of the kept policy, by the learners' objectives, m2/s2."""
        return float(self.results[RESULTS.index(OBJECTIVE)] or self.results[RESULTS.index(training_harm)])


def do_trial(job: TrialJob, log: Path) -> TrialEnd | None:
    """Train to the end, or to where the trial is pruned; None where it was stopped from outside.

    Raises what ``do_job`` of a sweep raises.
    """
    judge = _Judge(job)
    folder = job.training.folder
    if RunDirectory(folder).progress.is_file() and judge.prunes():  # it was killed before it could say so
        return TrialEnd(True, read_results(job.training.training, folder))
    found = do_job(job.training, log, judge)
    if found is not None:
        return TrialEnd(False, found)
    if not judge.pruned:
        return None
    log.unlink(missing_ok=True)
    return TrialEnd(True, read_results(job.training.training, folder))


def repeat_end(end: TrialEnd) -> TrialEnd:
    """A trial of which the same training has ended before."""
    return end


def refuse_trial(reason: str) -> TrialEnd:
    """A trial whose values do not go together; raises ``InvalidInput``."""
    raise InvalidInput(reason)


class _Judge:
    """Tells the study what is measured, and asks it whether to go on."""

    def __init__(self, job: TrialJob) -> None:
        self._job, self._study = job, TuningStudy(job.place)
        self._harm = HARM_METRIC[job.training.training.recipe.reward.harm_count]
        self.pruned = False

    def __call__(self, evaluation: Mapping[str, float]) -> str | None:
        step = int(self._job.times * evaluation["updates"]) // self._job.updates
        self._study.report(self._job.number, step, evaluation.get(OBJECTIVE, evaluation[self._harm]))
        self.pruned = step < self._job.times and self.prunes()
        return PRUNED if self.pruned else None

    def prunes(self) -> bool:
        """Whether the study would not go on."""
        return self._study.prunes(self._job.number)


# The table of a tuning, one row per trial, and the recipe of the best one.
#
# No time and no place stands in the table: with one worker it is the same, byte for byte, however often it was stopped.

TABLE = "trials.csv"


def write_table(folder: Path, plan: TuningPlan, trials: Sequence[TrialRecord]) -> Path:
    """Write the table and give its path.

    The values of ``RESULTS`` are those of the kept policy on the tuning's list, of a pruned trial of the best until
    then.
    """
    text = io.StringIO(newline="")
    writer = csv.writer(text, lineterminator="\n")
    keys = [*plan.file.search]
    writer.writerow(["trial", "state", "hash", *keys, *RESULTS, "reason"])
    for trial in trials:
        if trial.state == "waiting":
            continue
        values = trial.values or {}
        shown = [flow_text(values[key]) if key in values else "" for key in keys]
        found = trial.results or ("",) * len(RESULTS)
        writer.writerow([trial.number, trial.state, trial.identity, *shown, *found, trial.reason])
    path = folder / TABLE
    write_file(path, text.getvalue().encode())
    return path


def best_recipe(plan: TuningPlan, values: Values, file: Path, source: str) -> str:
    """The text of a recipe that trains what the trial with these values trained, named as its file.

    Raises ``InvalidInput`` for a file whose name cannot be a recipe's.
    """
    check_file_name("recipe", file.stem)
    described = f"Settings of {plan.file.recipe} that `ethbrake tune` found."
    recipe = plan.training(values).recipe.replace(
        name=file.stem, title=plan.file.title, description=described, source=source
    )
    return recipe_text(recipe, export_head(plan, file))


def export_head(plan: TuningPlan, file: Path) -> str:
    """The first line of an exported recipe."""
    settings = "".join(f" --set {text}" for text in scenario_texts(plan))
    command = f"ethbrake train --scenario {plan.file.scenario}{settings} --recipe {file.name}"
    return f"# The best trial of a tuning, trained again: {command}\n"


def scenario_texts(plan: TuningPlan) -> tuple[str, ...]:
    """Those settings of the file that are the scenario's, which no recipe can hold."""
    fields = type(plan.recipe).model_fields
    return texts_of(
        {
            key: value
            for key, value in plan.file.settings.items()
            if key.startswith("scenario.") or key.partition(".")[0] not in {*fields, "recipe"}
        }
    )


JOURNAL = "study.journal"
RUNS, LOGS = "trials", "logs"  # inside the tuning's folder
_RECORD, _LOCK = "tuning.json", "tuning.lock"


@dataclass(frozen=True, slots=True)
class TuningState:
    """How far a tuning is, for who is told."""

    done: int  # trials of this folder that have ended
    total: int
    least: float | None  # harm of the best so far, m2/s2
    note: str = ""  # to be told once


@dataclass(frozen=True, slots=True)
class Best:
    """The trial of least harm."""

    number: int
    harm: float  # on the tuning's list, m2/s2
    values: dict[str, Any]


@dataclass(frozen=True, slots=True)
class TuningResult:
    """What a tuning left behind."""

    table: Path
    counts: dict[str, int]  # state -> trials of the study
    best: Best | None
    interrupted: bool


def run_tuning(
    plan: TuningPlan,
    folder: Path,
    workers: Workers,
    trials: int,
    *,
    storage: str | None = None,
    retries: int = RETRIES,
    tell: Callable[[TuningState], None] | None = None,
) -> TuningResult:
    """Bring the trials of a folder to so many, and write their table, after Ctrl-C too.

    Args:
        plan: what every trial has in common.
        folder: of everything; made if it is not there.
        workers: where trials run; not closed here.
        trials: that this folder shall have altogether.
        storage: an address as Optuna takes it, which other folders may share; None: a journal file in the folder.
        retries: further attempts at a trial that was lost.
        tell: is told how far it is.

    Raises ``InvalidInput`` where the folder holds another tuning, or another process works in it, and where the storage
    cannot be used.

    """
    folder = folder.absolute()  # a worker may stand elsewhere
    for name in (RUNS, LOGS):
        (folder / name).mkdir(parents=True, exist_ok=True)
    with hold_lock(folder / _LOCK, "another process tunes here"):
        for each in (folder, folder / RUNS):
            remove_unfinished(each)
        place = place_of(plan, folder, storage)
        if place.private:
            mend_journal(Path(place.storage))
        tuning = _Tuning(plan, folder, place, _owner(plan, folder), tell or (lambda state: None))
        whole = run_jobs(tuning.call_of, tuning.prepare(trials), workers, tuning.note, retries=retries)
        found = tuning.study.trials()
        table = write_table(folder, plan, found)
    counts = Counter[str](trial.state for trial in found)
    return TuningResult(table, dict(counts), best_of(found), not whole)


def place_of(plan: TuningPlan, folder: Path, storage: str | None) -> Place:
    """Where the study of a tuning in ``folder`` stands."""
    return Place(str(folder.absolute() / JOURNAL) if storage is None else storage, plan.identity, plan.file)


def best_of(trials: Sequence[TrialRecord]) -> Best | None:
    """The finished trial of least harm, of equals the first; None where none has finished."""
    finished = [
        Best(trial.number, trial.harm, trial.values)
        for trial in trials
        if trial.harm is not None and trial.values is not None
    ]
    return min(finished, key=lambda best: (best.harm, best.number), default=None)


class _Tuning:
    """The trials of one call: those that go on first, then new ones."""

    def __init__(
        self, plan: TuningPlan, folder: Path, place: Place, owner: str, tell: Callable[[TuningState], None]
    ) -> None:
        self._plan, self._folder, self._place, self._owner, self._tell = plan, folder, place, owner, tell
        self.study = TuningStudy(place)
        self._harm = HARM_METRIC[plan.recipe.reward.harm_count]
        self._trials: dict[int, int] = {}  # number of the job -> of the trial
        self._done = self._total = 0

    def prepare(self, trials: int) -> int:
        """Take up what was begun, and give the number of jobs that make ``trials`` of this folder's."""
        known = self.study.trials()
        note = "" if known else self._enqueue_own()
        for trial in known:
            if trial.state == "running" and trial.values is None and self._is_mine(trial):
                self.study.fail(trial.number, "was killed while it was asked for")
        mine = [trial for trial in known if trial.values is not None and self._is_mine(trial)]
        begun = [trial.number for trial in mine if trial.state == "running"]
        self._trials = dict(enumerate(begun))
        self._done = len(mine) - len(begun)
        self._total = max(trials, len(mine))
        if mine:
            note = f"{count_of(self._done, 'trial')} ended already, {len(begun)} go on"
        self._say(note)
        return self._total - self._done

    def call_of(self, number: int) -> bytes:
        """What does a job: the trial it has, or a new one."""
        if number not in self._trials:
            self._trials[number] = self.study.ask(self._owner)
        trial = self.study.trial(self._trials[number])
        assert trial.values is not None
        try:
            training = self._plan.training(trial.values)
        except InvalidInput as error:
            return pack(refuse_trial, str(error))
        self.study.note_identity(trial.number, training.identity)
        for other in self.study.trials():
            if other.state == "finished" and other.identity == training.identity:
                return pack(repeat_end, TrialEnd(False, other.results))
        noted = texts_of({**self._plan.file.settings, **trial.values})
        job = TrainingJob(training, self._folder / RUNS / _name(trial.number), noted)
        updates, times = self._plan.updates(training.recipe), self._plan.file.measure.times
        return pack(do_trial, TrialJob(job, self._place, trial.number, times, updates), self._log(trial.number))

    def note(self, attempt: Attempt) -> None:
        """Tell the study how an attempt at a job has ended."""
        number = self._trials[attempt.number]
        end: TrialEnd | None = attempt.answer.value
        if end is None and not attempt.last:
            self._say(f"trial {number}: {reason_of(attempt)}; tried again after attempt {attempt.attempt}")
            return
        if end is None:
            self.study.fail(number, reason_of(attempt))
        elif end.pruned:
            self.study.prune(number, end.results)
        else:
            self.study.finish(number, end.harm(self._harm), end.results)
        self._done += 1
        self._say("" if end is not None else f"trial {number}: {reason_of(attempt)}; {self._log(number)}")

    def _enqueue_own(self) -> str:
        """Let the first trial be the recipe as it is, so that the best one can be compared with it."""
        values = self._plan.own_values()
        if values is None:
            return "the recipe's own values are not in the space, so no trial has them"
        self.study.enqueue(values)
        return ""

    def _is_mine(self, trial: TrialRecord) -> bool:
        """Whether this folder asked for it; in a file of its own also one that was killed before that was noted."""
        return trial.owner == self._owner or (self._place.private and not trial.owner)

    def _log(self, number: int) -> Path:
        return self._folder / LOGS / f"{_name(number)}.log"

    def _say(self, note: str) -> None:
        best = best_of(self.study.trials())
        self._tell(TuningState(self._done, self._total, None if best is None else best.harm, note))


def _name(trial: int) -> str:
    return f"{trial:04d}"


def check_tuning(plan: TuningPlan, folder: Path) -> None:
    """Raise ``InvalidInput`` where the folder holds another tuning, or one by other versions."""
    file = folder / _RECORD
    if not file.is_file():
        return
    record, now = read_object(file), installed_versions()
    then = record.get("versions")
    if isinstance(then, dict) and then != now:
        names = [name for name in {**then, **now} if then.get(name) != now.get(name)]
        other = "; ".join(f"{name} {then.get(name)}, here {now.get(name)}" for name in names)
        raise InvalidInput(f"{folder}: was tuned with {other}: harms could not be compared; give another folder")
    if record.get("tuning") != plan.identity:
        raise InvalidInput(f"{folder}: holds another tuning; give another folder (--output), or the same file")


def _owner(plan: TuningPlan, folder: Path) -> str:
    """By what the trials of this folder are known in a storage that others share; noted at the first call."""
    check_tuning(plan, folder)
    file = folder / _RECORD
    if not file.is_file():
        content = {
            "format": "ethbrake-tuning",
            "tuning": plan.identity,
            "owner": uuid.uuid4().hex,
            "versions": installed_versions(),
        }
        write_file(file, json.dumps(content, indent=2).encode() + b"\n")
    return str(read_object(file).get("owner"))


# The cost of a trial on this machine, told before anything is begun.

_TIMED_DRIVES = 50  # worlds that the timed policy drives


def seconds_per_trial(plan: TuningPlan) -> float:
    """Seconds of one core for a training with the recipe's own values, by a short one."""
    training = plan.training({})
    sample = training.scenario.sample(_TIMED_DRIVES, training.recipe.evaluation.seed)
    timed = time_training(training.recipe, training.scenario, sample)
    return training_seconds(training.recipe, training.scenario, timed, training.recipe.total_steps)
