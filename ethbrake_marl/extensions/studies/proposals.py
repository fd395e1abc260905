"""Proposals of Optuna for a tuning: the values to try in each trial, stored in a file and used again after a restart.

Each trial has a new Optuna sampler, whose seed depends on the number of the trial. Therefore a proposal depends on the
results of earlier trials, but not on interruptions of the command.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import optuna
from optuna.samplers import BaseSampler
from ray.tune.search.optuna import OptunaSearch

from ethbrake_marl.extensions.studies.figures import HARM
from ethbrake_marl.files.store import write_file

if TYPE_CHECKING:
    from optuna import Study
    from optuna.distributions import BaseDistribution
    from optuna.trial import FrozenTrial

Proposal = Mapping[str, Any]  # key -> value in Optuna's form


class Proposals(OptunaSearch):  # type: ignore[misc]  # Ray ships no types
    """Search algorithm of Ray Tune that asks Optuna for proposals, and stores each proposal in a file.

    A *proposal* contains the values to try in one trial, by key, as Optuna stores values.

    Args:
        file: JSON file of the proposals; it is created with the first proposal.
        known: proposals that the file already contains; trial number k gets proposal number k.
        space: Optuna's distribution of each searched key.
        sampler: function from the number of a trial to its Optuna sampler.
        first: proposal of the first trial, used only if ``known`` is empty; None: Optuna makes the first proposal.

    """

    def __init__(
        self,
        file: Path,
        known: Sequence[Proposal],
        space: Mapping[str, BaseDistribution],
        sampler: Callable[[int], BaseSampler],
        first: Proposal | None,
    ) -> None:
        optuna.logging.set_verbosity(optuna.logging.ERROR)
        self._file, self.known, self._asked = file, [*known], 0
        points = self.known or ([] if first is None else [first])
        super().__init__(
            dict(space),
            metric=HARM,
            mode="min",
            points_to_evaluate=[dict(each) for each in points],
            sampler=_SamplerOfTrial(sampler),
        )

    def suggest(self, trial_id: str) -> dict[str, Any] | None:
        """Return the configuration of the next trial: ``{"trial": number, "values": proposal}``.

        A new proposal is stored in the file.
        """
        values, number = super().suggest(trial_id), self._asked
        if number == len(self.known):
            self.known.append(values)
            write_file(self._file, (json.dumps({"trials": self.known}, indent=1) + "\n").encode())
        self._asked += 1
        return {"trial": number, "values": values}


class _SamplerOfTrial(BaseSampler):
    """Optuna sampler that uses the sampler ``of(k)`` for trial number k."""

    def __init__(self, of: Callable[[int], BaseSampler]) -> None:
        self._of = of

    def before_trial(self, study: Study, trial: FrozenTrial) -> None:
        self._sampler = self._of(trial.number)

    def infer_relative_search_space(self, study: Study, trial: FrozenTrial) -> dict[str, BaseDistribution]:
        return {}

    def sample_relative(self, study: Study, trial: FrozenTrial, search_space: Mapping[str, Any]) -> dict[str, Any]:
        return {}

    def sample_independent(self, study: Study, trial: FrozenTrial, name: str, distribution: BaseDistribution) -> Any:
        return self._sampler.sample_independent(study, trial, name, distribution)
