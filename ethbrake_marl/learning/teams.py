"""Training a team: several learners under one of the schemes, each with the network that drives it afterwards.

``load_team`` needs no torch; what trains imports it when it is called.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from ethbrake_marl.learning.recipe import Scheme, TrainingRecipe, load_recipe
from ethbrake_marl.learning.schemes import drivers
from ethbrake_marl.learning.team_file import is_team as is_team
from ethbrake_marl.learning.team_file import load_driver as load_driver
from ethbrake_marl.learning.team_file import load_team as load_team
from ethbrake_marl.policies.policy import Policy
from ethbrake_marl.policies.team import drivers_of
from ethbrake_marl.scenario import Scenario, load_scenario

if TYPE_CHECKING:
    from ethbrake_marl.learning.loop import Progress
    from ethbrake_marl.learning.train import Training


@dataclass(frozen=True, slots=True)
class TeamResult:
    """What the training of a team left behind."""

    directory: Path
    scheme: Scheme
    drivers: Mapping[str, str]  # vehicle -> bundle in the folder; team.json says the same
    policies: Mapping[str, Policy]  # vehicle -> its policy of the moment when the team had least harm
    status: Literal["finished", "interrupted"]
    steps: int  # decisions of all learners
    updates: int
    wall_s: float
    evaluations: tuple[Mapping[str, float], ...]
    alarms: tuple[str, ...]


def train_team(
    recipe: TrainingRecipe | str | Path,
    scenario: Scenario | str | Path,
    directory: str | Path,
    *,
    scheme: Scheme | None = None,
    turns: int | None = None,
    seed: int | None = None,
    steps: int | None = None,
    force: bool = False,
    on_progress: Callable[[Progress], None] | None = None,
) -> TeamResult:
    """Train the learners of ``scenario`` into the new ``directory``, measuring the team on the recipe's fixed list.

    Recipe and scenario may be given by name or path, too. ``scheme`` (see docs/cooperation.md), ``turns``, ``seed`` and
    ``steps`` override the recipe; without a scheme one learner is ``single`` and several are ``shared``. Everything
    else is as for ``learning.train.train``: the same bits from the same seed, Ctrl-C, checkpoints, resume, what it
    raises. Raises ``InvalidInput`` for a scheme that does not fit the learners or the algorithm.
    """
    from ethbrake_marl.learning.measure import measure_on_list  # these two import torch, a team that drives needs none
    from ethbrake_marl.learning.train import run_training

    recipe = recipe if isinstance(recipe, TrainingRecipe) else load_recipe(recipe)
    scenario = scenario if isinstance(scenario, Scenario) else load_scenario(scenario)
    changes = {"scheme": scheme, "turns": turns, "seed": seed, "total_steps": steps}
    recipe = recipe.replace(**{name: value for name, value in changes.items() if value is not None})
    measure = measure_on_list(recipe, scenario)
    return _result(run_training(recipe, scenario, Path(directory), force, measure, on_progress))


def resume_team(
    directory: str | Path,
    *,
    on_progress: Callable[[Progress], None] | None = None,
    other_versions: bool = False,
) -> TeamResult:
    """Go on with a training that was stopped or killed, under whatever scheme, as ``learning.train.resume`` does."""
    from ethbrake_marl.learning.measure import measure_on_list  # as above
    from ethbrake_marl.learning.train import resume_training

    return _result(resume_training(Path(directory), measure_on_list, on_progress, other_versions))


def _result(training: Training) -> TeamResult:
    course, kept = training.course, training.course.kept
    assert kept is not None  # set before the first rollout
    given = drivers(training.scheme, training.scenario)
    details: dict[str, Any] = {
        "steps": course.steps,
        "updates": course.updates,
        "wall_s": course.wall_s,
        "evaluations": tuple(course.evaluations),
        "alarms": tuple(course.alarms),
    }
    policies = drivers_of(kept, tuple(given))
    return TeamResult(training.run.path, training.scheme, given, policies, training.status, **details)
