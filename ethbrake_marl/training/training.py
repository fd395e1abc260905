"""``Training``: a recipe combined with a scenario, before the training begins."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ethbrake_marl.agents.registry import AGENTS
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.files.plain import read_object
from ethbrake_marl.files.yaml import Document
from ethbrake_marl.game.observations import ObservationSpec, choose_observation
from ethbrake_marl.game.observed import common_observation, observations_of
from ethbrake_marl.policies.manifest import installed_versions
from ethbrake_marl.scenario.catalogue import load_scenario
from ethbrake_marl.scenario.schema import Scenario
from ethbrake_marl.training.recipe import WORDS, Scheme, TrainingRecipe, load_recipe
from ethbrake_marl.training.run_folder import RunDirectory
from ethbrake_marl.training.team import TeamFile, bundle_of


@dataclass(frozen=True, slots=True)
class Training:
    """What is to be trained: a recipe combined with a scenario, and everything that follows from the two.

    Create it with ``Training.of``.
    """

    recipe: TrainingRecipe  # the recipe, with all changes
    scenario: Scenario  # the scenario, whose roles determine the learners
    scheme: Scheme  # how the learners train together: ``single``, ``shared``, ``independent`` or ``centralised``
    drivers: Mapping[str, str]  # learner's name, front to rear -> folder of its policy, inside the run's folder
    observation: ObservationSpec  # features of a row of the environment: everything that any learner observes
    observations: Mapping[str, ObservationSpec]  # features that each learner observes, by name

    @classmethod
    def of(cls, recipe: TrainingRecipe | str | Path, scenario: Scenario | str | Path, **changes: Any) -> Training:
        """Combine a recipe and a scenario, each an object, a name or a path. ``changes`` override keys of the recipe.

        Learners observe the recipe's features, or else the scenario's. Raises ``InvalidInput`` if recipe and scenario
        do not fit: no vehicle learns, the scheme needs another number of learners, or one policy would drive learners
        that observe different features.
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
        """For each learner, front to rear: the columns of an environment row that it observes."""
        place = {feature.name: column for column, feature in enumerate(self.observation.features)}
        return [[place[feature.name] for feature in spec.features] for spec in self.observations.values()]

    @property
    def begins(self) -> str | None:
        """Description of the initial weights; None if the algorithm always begins with random weights."""
        return self.recipe.begins(self.scenario)

    def content(self) -> dict[str, dict[str, Any]]:
        """Return everything that affects the training as plain data: ``{"recipe": {...}, "scenario": {...}}``.

        Defaults are included; descriptive texts are not.
        """
        recipe = self.recipe.model_dump(mode="json", exclude=set(WORDS))
        return {"recipe": recipe, "scenario": self.scenario.content(without=WORDS)}

    @property
    def identity(self) -> str:
        """SHA-256 of ``content()``, in hexadecimal digits; equal for trainings that give the same policy."""
        return self.identity_of(self.content())

    @staticmethod
    def identity_of(content: Mapping[str, Any]) -> str:
        """Return the SHA-256 of ``content`` (plain data, as ``content()`` returns it), in hexadecimal digits."""
        return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()

    def config(self, settings: Sequence[str] = ()) -> dict[str, Any]:
        """Return the content of ``config.json``: recipe, scenario, seeds and versions.

        ``settings`` (``KEY=VALUE`` each) say how recipe and scenario differ from their files; they are recorded.
        """
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
        """Return the name, as an agent, of what this training leaves in the run's ``folder``: ``ppo@runs/mine``."""
        several, algorithm = len(self.drivers) > 1, self.recipe.algorithm
        return f"{'team' if several else algorithm if algorithm in AGENTS else 'policy'}@{folder}"

    def who_drives(self) -> str:
        """Return scheme and drivers in words: ``scheme shared: policy drives vehicle_2, vehicle_3``."""
        bundles: dict[str, list[str]] = {}
        for vehicle, bundle in self.drivers.items():
            bundles.setdefault(bundle, []).append(vehicle)
        in_words = "; ".join(f"{bundle} drives {', '.join(vehicles)}" for bundle, vehicles in bundles.items())
        return f"scheme {self.scheme}: {in_words}"


def recorded_training(run: RunDirectory, config: Mapping[str, Any]) -> Training:
    """Return the training that the configuration of a run describes, for example to resume it.

    ``config`` is the content of the run's ``config.json``; ``run`` is named in errors. Raises ``InvalidInput`` for an
    invalid configuration, and for a training by another library.
    """
    if "library" in config:
        raise InvalidInput(f"{run.path}: was trained by {config['library']}, which cannot be resumed; train again")
    try:
        recipe = TrainingRecipe.of(config["recipe"])
        scenario = Scenario.from_document(Document("scenario", config["scenario"], {}))
    except KeyError as error:
        raise InvalidInput(f"{run.config}: is not the configuration of a training: {error} is missing") from None
    except InvalidInput as error:
        raise InvalidInput(f"{run.config}: {error}") from None
    return Training.of(recipe, scenario)


def check_same_training(run: RunDirectory, training: Training) -> None:
    """Raise ``InvalidInput``, naming the keys that differ, unless the run's folder holds this training."""
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
        f"{run.path}: holds another training (here other: {', '.join(other)}); give another folder (--output)"
    )
