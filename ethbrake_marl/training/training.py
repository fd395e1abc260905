"""``Training``: a recipe with a scenario, and what follows from both: learners, policies, observations."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

from ethbrake_marl.agent_names import check_path
from ethbrake_marl.episode.objectives import OBJECTIVES, objectives_of
from ethbrake_marl.episode.observe import View
from ethbrake_marl.errors import AlreadyExists, InvalidInput
from ethbrake_marl.policies.manifest import installed_versions
from ethbrake_marl.policies.network import NetworkSpec
from ethbrake_marl.training.recipe import Scheme, TrainingRecipe, load_recipe
from ethbrake_marl.worlds.catalogue import load_scenario
from ethbrake_marl.worlds.mixture import DESCRIPTIVE_KEYS
from ethbrake_marl.worlds.open_game import AnyScenario, views_of
from ethbrake_marl.worlds.scenario import Scenario

STATUS_FILE = "run.json"  # in the folder of a run


class Training(NamedTuple):
    """``Training.of`` checks that both fit each other. Equal trainings give equal policies."""

    recipe: TrainingRecipe
    scenario: Scenario
    scheme: Scheme  # how the learners train together
    learners: tuple[str, ...]  # names, front to rear
    views: tuple[View, ...]  # what each learner observes

    @classmethod
    def of(cls, recipe: Any, scenario: AnyScenario, **changes: Any) -> Training:
        """Learners observe what the recipe lists, or else what the scenario lists. ``changes``: other values for keys
        of the recipe. Raises ``InvalidInput``.
        """
        recipe, scenario = load_recipe(recipe), load_scenario(scenario)
        recipe = recipe.replace(**changes) if changes else recipe
        learners = tuple(scenario.vehicle_names[body - 1] for body in scenario.learners)
        every = views_of(scenario) if recipe.observation is None else (View(recipe.observation),) * scenario.vehicles
        views = tuple(every[body - 1] for body in scenario.learners)
        scheme: Scheme = recipe.scheme or ("single" if len(learners) == 1 else "shared")
        _check(recipe, scenario, scheme, learners)
        if scheme != "independent" and len(set(views)) > 1:
            raise InvalidInput(
                f"scheme {scheme}: {', '.join(learners)} share a policy, but observe different features in scenario"
                f" {scenario.name!r}; list the features of all in the recipe's key observation, or use the scheme"
                " independent"
            )
        return cls(recipe, scenario, scheme, learners, views)

    @property
    def drivers(self) -> dict[str, str]:
        """Folder of each learner's policy inside the run's folder, learner -> path."""
        return {name: f"policy/{name}" if self.scheme == "independent" else "policy" for name in self.learners}

    @property
    def groups(self) -> tuple[tuple[str, ...], ...]:
        """Learners that share a policy, front to rear."""
        return tuple((name,) for name in self.learners) if self.scheme == "independent" else (self.learners,)

    @property
    def networks(self) -> list[NetworkSpec]:
        firsts = [self.learners.index(group[0]) for group in self.groups]
        networks = [self.recipe.network_spec(len(self.views[first].names)) for first in firsts]
        if self.scheme == "centralised":  # a vehicle cannot use the critic
            return [network.model_copy(update={"value_hidden": ()}) for network in networks]
        return networks

    @property
    def row(self) -> View:
        """All features that at least one learner observes."""
        return View(list(dict.fromkeys(name for view in self.views for name in view.names)))

    @property
    def columns(self) -> list[list[int]]:
        """Columns of ``row`` that each learner observes."""
        place = {name: column for column, name in enumerate(self.row.names)}
        return [[place[name] for name in view.names] for view in self.views]

    @property
    def objective(self) -> str:
        """Name of what learners minimise, such as ``own``; empty if it is the line's harm, or harm has no weight."""
        declared = self.recipe.reward.objective or self.scenario.objective
        objectives = objectives_of(declared, self.scenario.vehicles)
        is_total = all(objective.kind is OBJECTIVES["total"] for objective in objectives)
        if is_total or not self.recipe.reward.harm:
            return ""
        if isinstance(declared, str):
            return declared
        return ", ".join(dict.fromkeys(declared[body - 1] for body in self.scenario.learners))

    def content(self) -> dict[str, dict[str, Any]]:
        """With defaults, without titles and descriptions."""
        recipe = self.recipe.model_dump(mode="json", exclude=set(DESCRIPTIVE_KEYS))
        return {"recipe": recipe, "scenario": self.scenario.content(without=DESCRIPTIVE_KEYS)}

    @property
    def identity(self) -> str:
        """SHA-256 of ``content``, in hexadecimal digits."""
        return hashlib.sha256(json.dumps(self.content(), sort_keys=True).encode()).hexdigest()

    def config(self, settings: Sequence[str] = ()) -> dict[str, Any]:
        return {
            "recipe": self.recipe.model_dump(mode="json"),
            "scenario": self.scenario.declared(),
            "seeds": {"training": self.recipe.seed, "evaluation": self.recipe.evaluation.seed},
            "versions": installed_versions(),
            **({"settings": list(settings)} if settings else {}),
        }

    def who_drives(self) -> str:
        """Such as ``scheme shared: policy drives vehicle_2, vehicle_3``."""
        parts = (f"{self.drivers[group[0]]} drives {', '.join(group)}" for group in self.groups)
        return f"scheme {self.scheme}: {'; '.join(parts)}"


def _check(recipe: TrainingRecipe, scenario: Scenario, scheme: Scheme, learners: Sequence[str]) -> None:
    where = f"scenario {scenario.name!r}"
    if not learners:
        raise InvalidInput(f"{where} has no learner; give at least one vehicle the role learner")
    if scheme == "single" and len(learners) > 1:
        raise InvalidInput(
            f"scheme single: {where} has {len(learners)} learners; use the scheme shared, independent or centralised,"
            " or a scenario with one learner"
        )
    if scheme == "independent" and len(learners) == 1:
        raise InvalidInput(f"scheme independent: needs several learners, but {where} has one; use the scheme single")
    if scheme not in recipe.schemes:
        raise InvalidInput(
            f"scheme {scheme}: the algorithm {recipe.algorithm} of recipe {recipe.name!r} does not support this scheme;"
            " use a recipe for PPO, for instance cooperation-ppo"
        )


def check_new_run(folder: Path, *, force: bool = False) -> bool:
    """Returns whether it replaces an earlier run, as ``force`` allows.

    Raises ``AlreadyExists`` if anything else is at this path, and ``InvalidInput`` for a comma or plus in the path.
    """
    check_path(folder)
    exists = os.path.lexists(folder)
    if exists and (folder.is_symlink() or not (folder / STATUS_FILE).is_file()):
        raise AlreadyExists(f"{folder}: already exists and is not the folder of a run; choose another name")
    if exists and not force:
        raise AlreadyExists(
            f"{folder}: this run already exists; choose another folder (--output), resume the run (ethbrake train"
            " --resume), or replace it (--force; make run ARGS=--force)"
        )
    return exists
