"""A training before it begins: a recipe on a scenario, and what follows from the two."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.game.observations import ObservationSpec, choose_observation
from ethbrake_marl.policies.manifest import installed_versions
from ethbrake_marl.policies.shipped import SHIPPED, shipped_name
from ethbrake_marl.scenario.catalogue import load_scenario
from ethbrake_marl.scenario.observed import common_observation, observations_of
from ethbrake_marl.scenario.schema import Scenario
from ethbrake_marl.training.recipe import WORDS, Scheme, TrainingRecipe, load_recipe
from ethbrake_marl.training.recipes import SacRecipe
from ethbrake_marl.training.team import TeamFile, bundle_of


@dataclass(frozen=True, slots=True)
class Training:
    """All that a training is before it begins; made by ``Training.of``."""

    recipe: TrainingRecipe
    scenario: Scenario
    scheme: Scheme
    drivers: Mapping[str, str]  # learner, front to rear -> where in the run's folder its bundle will stand
    observation: ObservationSpec  # of a learner's row: where each observes its own features, those of all
    observations: Mapping[str, ObservationSpec]  # of each learner

    @classmethod
    def of(cls, recipe: TrainingRecipe | str | Path, scenario: Scenario | str | Path, **changes: Any) -> Training:
        """The training of a recipe on a scenario, both given or by name or path; ``changes`` override the recipe.

        Learners observe what the recipe says; where it says nothing, what the scenario says. Raises ``InvalidInput``
        where they do not fit each other: nobody learns, the scheme is for others, or one policy for all is to drive
        learners that observe different features.
        """
        recipe = recipe if isinstance(recipe, TrainingRecipe) else load_recipe(recipe)
        scenario = scenario if isinstance(scenario, Scenario) else load_scenario(scenario)
        recipe = recipe.replace(**changes) if changes else recipe
        scheme = recipe.scheme_for(scenario)
        names = [scenario.vehicle_names[vehicle] for vehicle in scenario.learners]
        drivers = {name: bundle_of(scheme, name) for name in names}
        every = observations_of(scenario, recipe.observation)
        observations = {name: every[vehicle] for name, vehicle in zip(names, scenario.learners, strict=True)}
        if scheme == "independent" and len(set(observations.values())) > 1:
            listed = dict.fromkeys(feature.name for spec in observations.values() for feature in spec.features)
            observation = choose_observation([*listed], scenario.time_step_s)
        else:
            observation = common_observation(every, scenario)
        return cls(recipe, scenario, scheme, drivers, observation, observations)

    @property
    def columns(self) -> list[list[int]]:
        """Which numbers of its row each learner observes, front to rear."""
        place = {feature.name: column for column, feature in enumerate(self.observation.features)}
        return [[place[feature.name] for feature in spec.features] for spec in self.observations.values()]

    @property
    def start(self) -> str | None:
        """The policy whose weights it begins with, ``ppo@shipped/ppo``; None: random weights.

        A recipe's ``ppo@shipped`` stands for what ships for the scenario, if anything does.
        """
        asked: str | None = getattr(self.recipe, "start", None)
        kind, _, path = (asked or "").partition("@")
        if path != SHIPPED:
            return asked
        with suppress(InvalidInput):
            return f"{asked}/{shipped_name(kind, self.scenario, self.recipe.reward.harm_count)}"
        return None

    @property
    def begins(self) -> str | None:
        """What its weights begin as, in words; None where no recipe of its algorithm names a policy."""
        if "start" not in type(self.recipe).model_fields:
            return None
        asked, name = getattr(self.recipe, "start", None), self.scenario.name
        return self.start or f"random weights{'' if asked is None else f', as {asked} has none for scenario {name!r}'}"

    def content(self) -> dict[str, dict[str, Any]]:
        """What makes it what it is: plain data with every default in it, without words."""
        recipe = self.recipe.model_dump(mode="json", exclude=set(WORDS))
        return {"recipe": recipe, "scenario": self.scenario.content(without=WORDS)}

    @property
    def identity(self) -> str:
        """SHA-256 of its content, in hexadecimal digits."""
        return self.identity_of(self.content())

    @staticmethod
    def identity_of(content: Mapping[str, Any]) -> str:
        """SHA-256 of such content."""
        return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()

    def config(self, settings: Sequence[str] = ()) -> dict[str, Any]:
        """What ``config.json`` says of it, and of the ``settings`` by which it differs from files."""
        recipe = self.recipe
        return {
            "recipe": recipe.model_dump(mode="json"),
            "scenario": self.scenario.model_dump(mode="json", exclude_unset=True),  # as in its file: defaults may clash
            "seeds": {"training": recipe.seed, "evaluation": recipe.evaluation.seed},
            "versions": installed_versions(),
            **({"update_ratio": recipe.update_ratio} if isinstance(recipe, SacRecipe) else {}),
            **({"settings": list(settings)} if settings else {}),
        }

    def team(self) -> dict[str, Any]:
        """What ``team.json`` says of it."""
        file = TeamFile(scheme=self.scheme, vehicles=self.scenario.vehicles, drivers=dict(self.drivers))
        return file.model_dump(mode="json")

    def who_drives(self) -> str:
        """Its scheme and ``drivers`` to read: ``scheme shared: policy drives vehicle_2, vehicle_3``."""
        bundles: dict[str, list[str]] = {}
        for vehicle, bundle in self.drivers.items():
            bundles.setdefault(bundle, []).append(vehicle)
        told = "; ".join(f"{bundle} drives {', '.join(vehicles)}" for bundle, vehicles in bundles.items())
        return f"scheme {self.scheme}: {told}"
