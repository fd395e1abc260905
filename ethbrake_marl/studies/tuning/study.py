"""The study in Optuna's storage: proposals, what was measured on the way, and ends. Nothing else knows Optuna.

Trials are proposed by a sampler that is made anew for each, of the file's seed and the trial's number: what is proposed
depends on what had ended by then, and not on how often the command was stopped in between.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from ethbrake_marl.errors import InvalidInput, describe_error, naming_extras
from ethbrake_marl.files.yaml import flow_text
from ethbrake_marl.studies.tuning.file import Choices, Pruning, Range, Sampling, TuningFile
from ethbrake_marl.studies.tuning.plan import Values

if TYPE_CHECKING:
    from optuna import Trial
    from optuna.distributions import BaseDistribution
    from optuna.pruners import BasePruner
    from optuna.samplers import BaseSampler
    from optuna.storages import BaseStorage
    from optuna.trial import FrozenTrial

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
