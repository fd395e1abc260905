"""``Training``: the combination of a recipe and a scenario, which together define a training run."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.files.plain import read_object
from ethbrake_marl.files.yaml import Document
from ethbrake_marl.first_edition.agents.registry import AGENTS
from ethbrake_marl.first_edition.game.observations import ObservationSpec, choose_observation
from ethbrake_marl.first_edition.game.observed import common_observation, observations_of
from ethbrake_marl.first_edition.policies.manifest import installed_versions
from ethbrake_marl.first_edition.scenario.catalogue import load_scenario
from ethbrake_marl.first_edition.scenario.schema import Scenario
from ethbrake_marl.first_edition.training.recipe import WORDS, Scheme, TrainingRecipe, load_recipe
from ethbrake_marl.first_edition.training.run_folder import RunDirectory
from ethbrake_marl.first_edition.training.team import TeamFile, bundle_of


@dataclass(frozen=True, slots=True)
class Training:
    """Combination of a recipe and a scenario, with the learners and observations that follow from them.

    Use ``Training.of`` to create a ``Training``.
    """

    recipe: TrainingRecipe  # the recipe, with all changes
    scenario: Scenario  # the scenario, whose roles determine the learners
    scheme: Scheme  # how the learners train together: ``single``, ``shared``, ``independent`` or ``centralised``
    drivers: Mapping[str, str]  # learner's name, front to rear -> folder of its policy inside the run
    observation: ObservationSpec  # features of a row of the environment: all features that some learner observes
    observations: Mapping[str, ObservationSpec]  # learner's name -> features that the learner observes

    @classmethod
    def of(cls, recipe: TrainingRecipe | str | Path, scenario: Scenario | str | Path, **changes: Any) -> Training:
        """Return the combination of a recipe and a scenario.

        Learners observe the features that the recipe lists or, if the recipe lists none, the features that the scenario
        lists. ``changes`` are new values for keys of the recipe, such as ``seed=3``.

        Raises ``InvalidInput`` if recipe and scenario do not fit each other: no vehicle learns, the scheme needs
        another number of learners, or one policy would drive learners that observe different features.
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
        """For each learner, front to rear: the columns of an observation row that the learner observes."""
        place = {feature.name: column for column, feature in enumerate(self.observation.features)}
        return [[place[feature.name] for feature in spec.features] for spec in self.observations.values()]

    @property
    def begins(self) -> str | None:
        """Description of the initial weights; None if they are random."""
        return self.recipe.begins(self.scenario)

    def content(self) -> dict[str, dict[str, Any]]:
        """Return everything that affects the training as plain data ``{"recipe": {...}, "scenario": {...}}``.

        Default values are included, descriptive texts are not.
        """
        recipe = self.recipe.model_dump(mode="json", exclude=set(WORDS))
        return {"recipe": recipe, "scenario": self.scenario.content(without=WORDS)}

    @property
    def identity(self) -> str:
        """SHA-256 of ``content()``, in hexadecimal digits. Training runs with equal hashes give the same policy."""
        return self.identity_of(self.content())

    @staticmethod
    def identity_of(content: Mapping[str, Any]) -> str:
        """Return the SHA-256 of ``content``, a result of the method ``content``, in hexadecimal digits."""
        return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()

    def config(self, settings: Sequence[str] = ()) -> dict[str, Any]:
        """Return the content of ``config.json``: recipe, scenario, seeds, versions and settings."""
        recipe = self.recipe
        return {
            "recipe": recipe.model_dump(mode="json"),
            "scenario": self.scenario.model_dump(mode="json", exclude_unset=True),  # defaults may conflict
            "seeds": {"training": recipe.seed, "evaluation": recipe.evaluation.seed},
            "versions": installed_versions(),
            **recipe.derived(),
            **({"settings": list(settings)} if settings else {}),
        }

    def team(self) -> dict[str, Any]:
        """Return the content of ``team.json``: scheme, number of vehicles, and the folder of each learner's policy."""
        file = TeamFile(scheme=self.scheme, vehicles=self.scenario.vehicles, drivers=dict(self.drivers))
        return file.model_dump(mode="json")

    def agent_in(self, folder: Path) -> str:
        """Return the text that names the agent trained in the run's ``folder``, such as ``ppo@runs/mine``."""
        several, algorithm = len(self.drivers) > 1, self.recipe.algorithm
        return f"{'team' if several else algorithm if algorithm in AGENTS else 'policy'}@{folder}"

    def who_drives(self) -> str:
        """Return a text about scheme and policies, such as ``scheme shared: policy drives vehicle_2, vehicle_3``."""
        bundles: dict[str, list[str]] = {}
        for vehicle, bundle in self.drivers.items():
            bundles.setdefault(bundle, []).append(vehicle)
        in_words = "; ".join(f"{bundle} drives {', '.join(vehicles)}" for bundle, vehicles in bundles.items())
        return f"scheme {self.scheme}: {in_words}"


def recorded_training(run: RunDirectory, config: Mapping[str, Any]) -> Training:
    """Return the recipe and scenario in ``config``, the content of a run's ``config.json``.

    Raises ``InvalidInput``, which names the folder ``run``, if the configuration is invalid, or if another library
    trained the policies.
    """
    if "library" in config:
        raise InvalidInput(
            f"{run.path}: this run was trained with the library {config['library']}, so it cannot be resumed; train"
            " again"
        )
    try:
        recipe = TrainingRecipe.of(config["recipe"])
        scenario = Scenario.from_document(Document("scenario", config["scenario"], {}))
    except KeyError as error:
        raise InvalidInput(
            f"{run.config}: does not describe a training run, because the key {error} is missing"
        ) from None
    except InvalidInput as error:
        raise InvalidInput(f"{run.config}: {error}") from None
    return Training.of(recipe, scenario)


def check_same_training(run: RunDirectory, training: Training) -> None:
    """Raise ``InvalidInput`` if the run's recipe or scenario differs from ``training``; the message names the keys."""
    recorded = recorded_training(run, read_object(run.config))
    if recorded.identity == training.identity:
        return
    before, wanted = recorded.content(), training.content()
    other = [
        f"{part} {key}"
        for part in wanted
        for key in dict.fromkeys([*wanted[part], *before[part]])
        if key not in before[part] or key not in wanted[part] or before[part][key] != wanted[part][key]
    ]
    raise InvalidInput(
        f"{run.path}: this folder contains another training run, which differs in {', '.join(other)}; choose another"
        " folder (--output)"
    )
