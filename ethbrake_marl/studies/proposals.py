"""What Optuna proposes for a tuning, through Ray Tune, and kept in a file: what stands there is proposed again first.

A sampler is made anew for each trial, of the file's seed and the trial's number: what is proposed depends on what had
ended by then, and not on how often the command was stopped in between.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import optuna
from optuna.samplers import BaseSampler, RandomSampler, TPESampler
from ray.tune.search.optuna import OptunaSearch

from ethbrake_marl.files.store import write_file
from ethbrake_marl.studies.figures import HARM

if TYPE_CHECKING:
    from optuna import Study
    from optuna.distributions import BaseDistribution
    from optuna.trial import FrozenTrial

    from ethbrake_marl.studies.tuning import Dimension, Sampling

Proposal = Mapping[str, Any]  # key -> value as Optuna has it


class Proposals(OptunaSearch):
    """Optuna's search of a space; a trial's configuration is its ``trial``, a number, and its ``values``.

    Args:
        file: of the proposals; made with the first one.
        known: what stands in it.
        search: the space.
        sampling: who proposes.
        first: the first proposal, where none is known.

    """

    def __init__(
        self,
        file: Path,
        known: Sequence[Proposal],
        search: Mapping[str, Dimension],
        sampling: Sampling,
        first: Proposal | None,
    ) -> None:
        optuna.logging.set_verbosity(optuna.logging.ERROR)
        self._file, self.known, self._asked = file, [*known], 0
        points = self.known or ([] if first is None else [first])
        super().__init__(
            {key: dimension.distribution() for key, dimension in search.items()},
            metric=HARM,
            mode="min",
            points_to_evaluate=[dict(each) for each in points],
            sampler=_SeededByTrial(sampling),
        )

    def suggest(self, trial_id: str) -> dict[str, Any] | None:
        """The next trial."""
        values, number = super().suggest(trial_id), self._asked
        if number == len(self.known):
            self.known.append(values)
            write_file(self._file, (json.dumps({"trials": self.known}, indent=1) + "\n").encode())
        self._asked += 1
        return {"trial": number, "values": values}


class _SeededByTrial(BaseSampler):
    """A sampler for each trial, seeded by its number."""

    def __init__(self, sampling: Sampling) -> None:
        self._sampling = sampling

    def before_trial(self, study: Study, trial: FrozenTrial) -> None:
        asked = self._sampling
        seed = int(np.random.SeedSequence([asked.seed, trial.number]).generate_state(1)[0])
        self._sampler: BaseSampler = (
            RandomSampler(seed=seed)
            if asked.name == "random"
            else TPESampler(seed=seed, n_startup_trials=asked.random_trials)
        )

    def infer_relative_search_space(self, study: Study, trial: FrozenTrial) -> dict[str, BaseDistribution]:
        return {}

    def sample_relative(self, study: Study, trial: FrozenTrial, search_space: Mapping[str, Any]) -> dict[str, Any]:
        return {}

    def sample_independent(self, study: Study, trial: FrozenTrial, name: str, distribution: BaseDistribution) -> Any:
        return self._sampler.sample_independent(study, trial, name, distribution)
