"""Train one policy: recipe and scenario in, a run's folder with a policy out; or go on with one that stopped."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from pydantic import ValidationError
from stable_baselines3.common.vec_env import VecEnv

from ethbrake_marl.durable_files import remove_unfinished
from ethbrake_marl.envs.sb3 import make_sb3_vec_env
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.learning.bundle import Policy, make_policy
from ethbrake_marl.learning.callback import BetweenUpdates, Evaluate, Progress
from ethbrake_marl.learning.checkpoint import TrainingState, newest_usable
from ethbrake_marl.learning.course import Course
from ethbrake_marl.learning.manifest import observation_schema
from ethbrake_marl.learning.model_state import Model
from ethbrake_marl.learning.models import make_model
from ethbrake_marl.learning.random_state import own_random_state
from ethbrake_marl.learning.recipe import SacRecipe, TrainingRecipe, recipe_of
from ethbrake_marl.learning.run_directory import RunDirectory, create_run, only_process, open_run
from ethbrake_marl.learning.sb3_policy import tensors_of
from ethbrake_marl.learning.session import Session
from ethbrake_marl.learning.stop_signal import stop_on_signal
from ethbrake_marl.learning.versions import installed_versions
from ethbrake_marl.observations import ObservationSpec
from ethbrake_marl.scenario import Scenario

OBSERVATION = ObservationSpec()  # what a learner sees: itself, and one neighbour on each side


@dataclass(frozen=True, slots=True)
class TrainResult:
    """What a training left behind."""

    directory: Path
    policy: Policy  # of least harm on the fixed list, the last where none was measured; also saved as directory/policy
    last_policy: Policy  # also saved as directory/policy-last
    status: Literal["finished", "interrupted"]
    steps: int  # decisions of learners, a multiple of rows x rounds
    updates: int
    wall_s: float
    evaluations: tuple[Mapping[str, float], ...]
    alarms: tuple[str, ...]  # return up, harm not down


def train(
    recipe: TrainingRecipe,
    scenario: Scenario,
    directory: str | Path,
    *,
    seed: int | None = None,
    steps: int | None = None,
    force: bool = False,
    evaluate: Evaluate | None = None,
    on_progress: Callable[[Progress], None] | None = None,
) -> TrainResult:
    """Train on ``scenario`` (its roles say who learns; several learners share one policy) into the new ``directory``.

    ``seed`` and ``steps`` override the recipe. Training ends after the first update at or beyond ``steps``.
    ``evaluate(policy)`` is called before the first update, then as the recipe says, and at the end. The same recipe,
    scenario, seed and machine give the same policy, bit for bit; global random states are left as they were.

    Ctrl-C stops after the update in progress (status ``interrupted``); a second one raises ``KeyboardInterrupt``.
    Whatever ends it but a kill, ``policy/`` holds the best policy so far and ``policy-last/`` the last good one;
    ``resume`` goes on. Raises ``AlreadyExists`` for an existing directory without ``force``, ``InvalidInput`` for a
    scenario without learners, ``TrainingDiverged`` for numbers that are not finite.
    """
    changes = {"seed": seed, "total_steps": steps}
    recipe = recipe.replace(**{name: value for name, value in changes.items() if value is not None})
    if not scenario.learners:
        raise InvalidInput(f"scenario {scenario.name!r}: no vehicle learns; give at least one the role learner")

    def begin() -> tuple[RunDirectory, None]:
        return create_run(Path(directory), _config(recipe, scenario), force=force), None

    return _run(begin, recipe, scenario, evaluate, on_progress)


def resume(
    directory: str | Path,
    *,
    evaluate: Callable[[TrainingRecipe, Scenario], Evaluate | None] | None = None,
    on_progress: Callable[[Progress], None] | None = None,
    other_versions: bool = False,
) -> TrainResult:
    """Go on with a training that was stopped or killed, to the policy that it would have come to: the same bits.

    It goes on from the newest checkpoint that is whole, or from the beginning when there is none; rows and events
    after that checkpoint are dropped, so that nothing stands twice. ``evaluate(recipe, scenario)`` gives the function
    that measures, which must be the one of ``train``. Raises ``InvalidInput`` for a folder without a training, one
    that has finished, one in which another process trains, and a checkpoint written by other versions, whose numbers
    may differ, unless ``other_versions``.
    """
    run, config = open_run(Path(directory))
    try:
        recipe = recipe_of(json.dumps(config["recipe"]))
        scenario = Scenario.model_validate_json(json.dumps(config["scenario"]))
    except (KeyError, ValidationError) as error:
        raise InvalidInput(f"{run.config}: is not the configuration of a training ({error})") from None
    measure = None if evaluate is None else evaluate(recipe, scenario)
    return _run(lambda: (run, other_versions), recipe, scenario, measure, on_progress)


def _run(
    begin: Callable[[], tuple[RunDirectory, bool | None]],
    recipe: TrainingRecipe,
    scenario: Scenario,
    evaluate: Evaluate | None,
    on_progress: Callable[[Progress], None] | None,
) -> TrainResult:
    """Train in the folder that ``begin`` makes or finds, once nothing can be wrong with environment and model.

    What else it gives is None for a new training, else whether other versions may go on with it.
    """
    with own_random_state(), stop_on_signal() as stop, _environment(recipe, scenario) as environment:
        model = make_model(recipe, environment)
        run, other_versions = begin()
        with only_process(run):
            found = None if other_versions is None else _newest(run, other_versions)
            session = Session(run, model, recipe)
            between = BetweenUpdates(
                recipe,
                _policy_maker(recipe, scenario),
                save=session.save,
                stop=stop,
                evaluate=evaluate,
                on_progress=on_progress,
            )
            if found is not None:
                session.restore(between, found[0])
                between.notes += [f"a damaged checkpoint was left aside: {reason}" for reason in found[1]]
            status = session.learn(between)
    return _result(run, between.course, status)


def _result(run: RunDirectory, course: Course, status: Literal["finished", "interrupted"]) -> TrainResult:
    assert course.policy is not None and course.kept is not None  # set before the first rollout
    return TrainResult(
        run.path,
        course.kept,
        course.policy,
        status,
        course.steps,
        course.updates,
        course.wall_s,
        tuple(course.evaluations),
        tuple(course.alarms),
    )


def _newest(run: RunDirectory, other_versions: bool) -> tuple[TrainingState | None, list[str]]:
    """The newest whole checkpoint, if there is one, and what was wrong with newer ones."""
    remove_unfinished(run.path)
    if not run.checkpoints.is_dir():
        return None, []
    remove_unfinished(run.checkpoints)
    state, damaged = newest_usable(run.checkpoints)
    if state is not None and not other_versions:
        _check_versions(run, state.versions)
    return state, damaged


def _check_versions(run: RunDirectory, then: Mapping[str, str]) -> None:
    now = installed_versions()
    for name in sorted(now.keys() | then.keys()):
        if now.get(name) != then.get(name):
            raise InvalidInput(
                f"{run.path}: was trained with {name} {then.get(name)}, here is {now.get(name)}: the numbers would"
                " differ; install that version, or go on all the same with --other-versions"
            )


def _policy_maker(recipe: TrainingRecipe, scenario: Scenario) -> Callable[[Model], Policy]:
    """How to make a policy of the model's present weights."""
    network = recipe.network_spec(OBSERVATION.size)
    fixed = {
        "algorithm": recipe.algorithm,
        "network": network,
        "observation": observation_schema(OBSERVATION),
        "learners": tuple(scenario.vehicle_names[vehicle] for vehicle in scenario.learners),
        "scenario": scenario.model_dump(mode="json"),
        "reward": recipe.reward.model_dump(mode="json"),
        "seeds": {"training": recipe.seed},
        "versions": installed_versions(),
    }
    return lambda model: make_policy(tensors_of(model.policy, network), steps=model.num_timesteps, **fixed)


def _config(recipe: TrainingRecipe, scenario: Scenario) -> dict[str, Any]:
    stated = {"update_ratio": recipe.update_ratio} if isinstance(recipe, SacRecipe) else {}
    return {
        "recipe": recipe.model_dump(mode="json"),
        "scenario": scenario.model_dump(mode="json", exclude_unset=True),  # what its file says: defaults may clash
        "seeds": {"training": recipe.seed, "evaluation": recipe.evaluation.seed},
        "versions": installed_versions(),
        **stated,
    }


@contextmanager
def _environment(recipe: TrainingRecipe, scenario: Scenario) -> Iterator[VecEnv]:
    environment = make_sb3_vec_env(
        scenario,
        recipe.n_envs,
        recipe.seed,
        reward=recipe.reward,
        observation=OBSERVATION,
        horizon_is_end=recipe.horizon_is_end,
    )
    try:
        yield environment
    finally:
        environment.close()
