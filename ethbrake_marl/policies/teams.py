"""Policies of several learners that were trained together, one for each: in memory and as a folder of bundles."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from ethbrake_marl.errors import CorruptBundle
from ethbrake_marl.files.store import new_folder
from ethbrake_marl.policies.bundle import load_policy
from ethbrake_marl.policies.policy import MANIFEST, Policy


@dataclass(frozen=True)
class PolicyTeam:
    """Policies of learners that were trained together, one for each."""

    drivers: Mapping[str, Policy]  # vehicle -> policy, front to rear: ``{"vehicle_2": policy, ...}``

    @property
    def steps(self) -> int:
        """Number of learners' decisions in training before the policies were saved."""
        return next(iter(self.drivers.values())).steps

    def save(self, folder: str | os.PathLike[str], *, replace: bool = False) -> None:
        """Write a folder with one bundle per learner, in ``vehicle_2/`` and so on, each as by ``Policy.save``.

        Raises ``AlreadyExists`` if the folder exists; with ``replace`` it is deleted once the new one is written.
        """
        with new_folder(Path(folder), replace=replace) as partial:
            for name, policy in self.drivers.items():
                policy.save(partial / name)


Trained = Policy | PolicyTeam  # result of a training: one policy for all learners, or one for each


def read_trained(folder: Path) -> Trained:
    """Read the policy or team that ``save`` wrote into ``folder``.

    Raises ``CorruptBundle`` if there is neither, and what ``load_policy`` raises.
    """
    if (folder / MANIFEST).exists():
        return load_policy(folder)
    names = sorted((path.name for path in folder.glob("vehicle_*")), key=lambda name: int(name.split("_")[1]))
    if not names:
        raise CorruptBundle(f"{folder}: holds neither a bundle nor one for each learner")
    return PolicyTeam({name: load_policy(folder / name) for name in names})
