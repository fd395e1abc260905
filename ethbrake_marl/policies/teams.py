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
    """One policy for each learner, by the vehicle's name, front to rear."""

    drivers: Mapping[str, Policy]

    @property
    def steps(self) -> int:
        """Decisions of learners after which they were taken."""
        return next(iter(self.drivers.values())).steps

    def save(self, folder: str | os.PathLike[str], *, replace: bool = False) -> None:
        """Write a folder ``vehicle_i/`` for each learner with its bundle, as ``Policy.save`` writes one."""
        with new_folder(Path(folder), replace=replace) as partial:
            for name, policy in self.drivers.items():
                policy.save(partial / name)


Trained = Policy | PolicyTeam  # what a training makes: one policy for all its learners, or one for each


def read_trained(folder: Path) -> Trained:
    """Read what their ``save`` wrote; raises ``CorruptBundle``, and what ``load_policy`` raises."""
    if (folder / MANIFEST).exists():
        return load_policy(folder)
    names = sorted((path.name for path in folder.glob("vehicle_*")), key=lambda name: int(name.split("_")[1]))
    if not names:
        raise CorruptBundle(f"{folder}: holds neither a bundle nor one for each learner")
    return PolicyTeam({name: load_policy(folder / name) for name in names})
