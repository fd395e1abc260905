"""Policies of several learners that were trained together, in memory and as a folder with one bundle per learner."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from ethbrake_marl.errors import CorruptBundle
from ethbrake_marl.files.store import new_folder
from ethbrake_marl.first_edition.policies.bundle import load_policy
from ethbrake_marl.first_edition.policies.policy import MANIFEST, Policy


@dataclass(frozen=True)
class PolicyTeam:
    """Policies of several learners that were trained together, one for each learner."""

    drivers: Mapping[str, Policy]  # vehicle name -> policy, front to rear: ``{"vehicle_2": policy, ...}``

    @property
    def steps(self) -> int:
        """Number of decisions that the learners made in training before the policies were saved."""
        return next(iter(self.drivers.values())).steps

    def save(self, folder: str | os.PathLike[str], *, replace: bool = False) -> None:
        """Write a folder with one subfolder per learner, such as ``vehicle_2/``; each contains the learner's bundle.

        Raises ``AlreadyExists`` if the folder exists. With ``replace``, an existing folder with this path is deleted
        after the new folder was written.
        """
        with new_folder(Path(folder), replace=replace) as partial:
            for name, policy in self.drivers.items():
                policy.save(partial / name)


Trained = Policy | PolicyTeam  # result of a training: one policy for all learners, or one policy for each learner


def read_trained(folder: Path) -> Trained:
    """Read the policy or team that ``save`` wrote into ``folder``.

    Raises ``CorruptBundle`` if ``folder`` contains neither a policy nor a team, and the errors of
    ``load_policy``.
    """
    if (folder / MANIFEST).exists():
        return load_policy(folder)
    names = sorted((path.name for path in folder.glob("vehicle_*")), key=lambda name: int(name.split("_")[1]))
    if not names:
        raise CorruptBundle(f"{folder}: must contain a policy bundle, or one folder vehicle_... per learner")
    return PolicyTeam({name: load_policy(folder / name) for name in names})
