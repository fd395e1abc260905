"""Run a tuning: trials that ended are kept, those that were begun go on, new ones are asked for as there is room."""

from __future__ import annotations

import json
import uuid
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ethbrake_marl.errors import InvalidInput, count_of
from ethbrake_marl.files.durable import hold_lock, remove_unfinished, write_file
from ethbrake_marl.learning.progress import HARM_METRIC
from ethbrake_marl.learning.run_folder import read_object
from ethbrake_marl.policies.manifest import installed_versions
from ethbrake_marl.studies.jobs.run import RETRIES, Attempt, run_jobs
from ethbrake_marl.studies.jobs.training import TrainingJob
from ethbrake_marl.studies.jobs.work import Workers, pack
from ethbrake_marl.studies.sweep.journal import reason_of
from ethbrake_marl.studies.tuning.plan import TuningPlan, texts_of
from ethbrake_marl.studies.tuning.study import Place, TrialRecord, TuningStudy, mend_journal
from ethbrake_marl.studies.tuning.table import write_table
from ethbrake_marl.studies.tuning.trial import TrialEnd, TrialJob, do_trial, refuse_trial, repeat_end

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
