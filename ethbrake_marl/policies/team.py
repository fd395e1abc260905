"""Policies of several learners that were trained together, one for each: in memory and as a folder of bundles."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from ethbrake_marl.errors import CorruptBundle
from ethbrake_marl.files.durable import new_folder
from ethbrake_marl.policies.policy import MANIFEST, Policy, load_policy, save_policy


@dataclass(frozen=True)
class PolicyTeam:
    """One policy for each learner, by the vehicle's name, front to rear."""

    members: Mapping[str, Policy]


Trained = Policy | PolicyTeam  # what a training makes: one policy for all its learners, or one for each


def steps_of(trained: Trained) -> int:
    """Decisions of learners after which it was taken."""
    policy = trained if isinstance(trained, Policy) else next(iter(trained.members.values()))
    return policy.manifest.steps


def drivers_of(trained: Trained, learners: tuple[str, ...]) -> dict[str, Policy]:
    """The policy that drives each of the ``learners``."""
    return dict.fromkeys(learners, trained) if isinstance(trained, Policy) else dict(trained.members)


def save_trained(trained: Trained, folder: Path, *, replace: bool = False) -> None:
    """Write a bundle, or a folder ``vehicle_i/`` for each learner with its bundle: completely or not at all.

    ``replace`` and what is raised: as for ``save_policy``.
    """
    if isinstance(trained, Policy):
        save_policy(trained, folder, replace=replace)
        return
    with new_folder(folder, replace=replace) as partial:
        for name, policy in trained.members.items():
            save_policy(policy, partial / name)


def read_trained(folder: Path) -> Trained:
    """Read what ``save_trained`` wrote; raises ``CorruptBundle``, and what ``load_policy`` raises."""
    if (folder / MANIFEST).exists():
        return load_policy(folder)
    names = sorted((path.name for path in folder.glob("vehicle_*")), key=lambda name: int(name.split("_")[1]))
    if not names:
        raise CorruptBundle(f"{folder}: holds neither a bundle nor one for each learner")
    return PolicyTeam({name: load_policy(folder / name) for name in names})
