"""``StepMemory``: all memory of a step shield about its running episodes, as one value."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from ethbrake_marl.first_edition.physics.state import Bools, Floats, Ints
from ethbrake_marl.first_edition.shields.certify import Backup
from ethbrake_marl.first_edition.shields.running import Running, put


class StepMemory(NamedTuple):
    """Memory of a step shield for n episodes. No array is ever changed in place."""

    running: Running | None = None  # the episodes that the shield predicts; None before the first episode
    backup: Backup = Backup(np.zeros((0, 0)), np.zeros(0))  # the certified plan and its harm
    first_bound: Floats = np.zeros(0)  # [n] harm of the plan at the first decision (m2/s2)
    alone_harm: Floats = np.zeros(0)  # [n] harm if the policy drove unshielded (m2/s2); infinity without a policy
    settles: Bools = np.zeros(0, np.bool_)  # [n] whether all vehicles rest at the horizon under the first plan
    replaced: Ints = np.zeros(0, np.int64)  # [n] or [n, K] number of actions replaced so far in the episode
    distrusted: Bools = np.zeros(0, np.bool_)  # [n] whether the world differed from the prediction
    baseline_shares: Floats = np.zeros((0, 0))  # [n, N] harm of each vehicle under the best constant actions (m2/s2)
    episode: Ints = np.zeros(0, np.int64)  # [n] number of each row's running episode, from 0
    logged: int = 0  # number of interventions in the log

    def take(self, rows: Ints) -> StepMemory:
        """Return the memory of only the episodes in the rows ``rows``."""
        running, backup = self.running, self.backup
        return self._replace(
            running=None if running is None else running.take(rows),
            backup=backup._replace(plan=backup.plan[rows], harm=backup.harm[rows]),
            **{name: getattr(self, name)[rows] for name in (*BEGUN, "episode")},
        )

    def put(self, rows: Ints, begun: StepMemory) -> StepMemory:
        """Return a copy of this memory in which new episodes replace the episodes in the rows ``rows``.

        ``begun`` is the memory of the new episodes, in the order of ``rows``. If there are at least as many new
        episodes as rows in the batch, the new episodes replace the whole batch. Each new episode gets a higher number
        than the old episode in its row.
        """
        old, new = self.running, begun.running
        assert new is not None
        if old is None or new.n >= old.n:
            episode = np.full(len(rows), self.episode.max(initial=-1) + 1)
            return begun._replace(episode=episode, logged=self.logged).take(np.argsort(rows))
        at = old.rows_of(rows)
        running = Running(
            old.problem.put(at, new.problem), put(old.states, at, new.states), put(old.steps, rows, new.steps),
            put(old.ended, at, new.ended), put(old.caps, at, new.caps) if old.caps.size else old.caps,
        )  # fmt: skip
        plan, harm = put(self.backup.plan, rows, begun.backup.plan), put(self.backup.harm, rows, begun.backup.harm)
        columns: dict[str, Any] = {name: put(getattr(self, name), rows, getattr(begun, name)) for name in BEGUN}
        columns["episode"] = put(self.episode, rows, self.episode[rows] + 1)
        backup = begun.backup._replace(plan=plan, harm=harm)
        return self._replace(running=running, backup=backup, **columns)


BEGUN = (
    "first_bound",
    "alone_harm",
    "settles",
    "replaced",
    "distrusted",
    "baseline_shares",
)  # set by ``begin``, [n, ...]
