"""Train one policy: recipe and scenario in, a run's folder with a policy out; or go on with one that stopped."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ethbrake_marl.envs.sb3 import Appended, EthBrakeVecEnv, make_sb3_vec_env
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.files.durable import remove_unfinished
from ethbrake_marl.learning.checkpoint import TrainingState, newest_usable
from ethbrake_marl.learning.checkpoint_fit import check_fits
from ethbrake_marl.learning.kept_training import asked_for, fingerprint
from ethbrake_marl.learning.loop import BetweenUpdates, Evaluate, Progress
from ethbrake_marl.learning.model_state import own_random_state
from ethbrake_marl.learning.models import make_model, policy_maker
from ethbrake_marl.learning.progress import Course
from ethbrake_marl.learning.recipe import SacRecipe, Scheme, TrainingRecipe, load_recipe
from ethbrake_marl.learning.run_folder import RunDirectory, create_run, has_finished, only_process, open_run
from ethbrake_marl.learning.schemes import scheme_of
from ethbrake_marl.learning.session import Ended, Session
from ethbrake_marl.learning.stop_signal import stop_on_signal
from ethbrake_marl.learning.team_file import team_content
from ethbrake_marl.observations import observation_for
from ethbrake_marl.policies.manifest import installed_versions
from ethbrake_marl.policies.policy import Policy
from ethbrake_marl.scenario import Scenario, load_scenario

_APPENDED: dict[Scheme, Appended] = {"independent": "number", "centralised": "state"}


@dataclass(frozen=True, slots=True)
class Training:
    """A training that has ended or was interrupted: its folder, and what it has reached."""

    run: RunDirectory
    course: Course
    status: Ended
    scheme: Scheme
    scenario: Scenario


@dataclass(frozen=True, slots=True)
class TrainResult:
    """What a training left behind."""

    directory: Path
    policy: Policy  # of least harm on the fixed list, the last where none was measured; also saved as directory/policy
    last_policy: Policy  # also saved as directory/policy-last
    status: Ended
    steps: int  # decisions of learners, a multiple of rows x rounds
    updates: int
    wall_s: float
    evaluations: tuple[Mapping[str, float], ...]
    alarms: tuple[str, ...]  # return up, harm not down


def train(
    recipe: TrainingRecipe | str | Path,
    scenario: Scenario | str | Path,
    directory: str | Path,
    *,
    seed: int | None = None,
    steps: int | None = None,
    force: bool = False,
    evaluate: Evaluate | None = None,
    on_progress: Callable[[Progress], None] | None = None,
) -> TrainResult:
    """Train on ``scenario`` (its roles say who learns; several learners share one policy) into the new ``directory``.

    Recipe and scenario may be given by name or path, too. A recipe whose scheme makes a policy for each learner is for
    ``learning.teams.train_team``.
    ``seed`` and ``steps`` override the recipe. Training ends after the first update at or beyond ``steps``.
    ``evaluate(policy)`` is called before the first update, then as the recipe says, and at the end. The same recipe,
    scenario, seed and machine give the same policy, bit for bit; global random states are left as they were.

    Ctrl-C stops after the update in progress (status ``interrupted``); a second one raises ``KeyboardInterrupt``.
    Whatever ends it but a kill, ``policy/`` holds the best policy so far and ``policy-last/`` the last good one;
    ``resume`` goes on. Raises ``AlreadyExists`` for an existing directory without ``force``, ``InvalidInput`` for a
    scenario without learners, ``TrainingDiverged`` for numbers that are not finite.
    """
    recipe = recipe if isinstance(recipe, TrainingRecipe) else load_recipe(recipe)
    scenario = scenario if isinstance(scenario, Scenario) else load_scenario(scenario)
    if scheme_of(recipe, scenario) == "independent":
        raise InvalidInput(f"recipe {recipe.name!r}: scheme independent makes several policies; use train_team")
    changes = {"seed": seed, "total_steps": steps}
    recipe = recipe.replace(**{name: value for name, value in changes.items() if value is not None})
    return _result(run_training(recipe, scenario, Path(directory), force, evaluate, on_progress))


def run_training(
    recipe: TrainingRecipe,
    scenario: Scenario,
    directory: Path,
    force: bool,
    evaluate: Evaluate | None,
    on_progress: Callable[[Progress], None] | None,
) -> Training:
    """What ``train`` does, under whatever scheme; ``evaluate`` gets a ``Policy``, or a ``PolicyTeam``."""
    team = team_content(scheme_of(recipe, scenario), scenario)

    def begin() -> tuple[RunDirectory, None]:
        return create_run(directory, _config(recipe, scenario), team=team, force=force), None

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
    that has finished, one in which another process trains, one whose ``config.json`` was edited since the checkpoint,
    and a checkpoint written by other versions, whose numbers may differ, unless ``other_versions``.
    """
    if scheme_of(*_asked_for(Path(directory))[1:]) == "independent":
        raise InvalidInput(f"{directory}: its learners have a policy each; go on with resume_team")
    return _result(resume_training(Path(directory), evaluate, on_progress, other_versions))


def resume_training(
    directory: Path,
    evaluate: Callable[[TrainingRecipe, Scenario], Evaluate | None] | None,
    on_progress: Callable[[Progress], None] | None,
    other_versions: bool,
) -> Training:
    """What ``resume`` does, under whatever scheme."""
    run, recipe, scenario = _asked_for(directory)
    measure = None if evaluate is None else evaluate(recipe, scenario)
    team = team_content(scheme_of(recipe, scenario), scenario)

    def begin() -> tuple[RunDirectory, bool]:
        run.write_json(run.team, team)  # follows from what was asked for; a damaged one would stay
        return run, other_versions

    return _run(begin, recipe, scenario, measure, on_progress)


def _asked_for(directory: Path) -> tuple[RunDirectory, TrainingRecipe, Scenario]:
    """The training that was begun in a folder."""
    run, config = open_run(directory)
    recipe, scenario = asked_for(directory, config)
    if has_finished(run):
        alone = len(scenario.learners) == 1
        agents = f"{recipe.algorithm}@{directory}+episode" if alone else f"team@{directory}"
        raise InvalidInput(
            f"{directory}: this training has finished; measure what it has learned with: ethbrake evaluate --scenario"
            f" {scenario.name} --agents {agents}"
        )
    return run, recipe, scenario


def _run(
    begin: Callable[[], tuple[RunDirectory, bool | None]],
    recipe: TrainingRecipe,
    scenario: Scenario,
    evaluate: Evaluate | None,
    on_progress: Callable[[Progress], None] | None,
) -> Training:
    """Train in the folder that ``begin`` makes or finds, once nothing can be wrong with environment and model.

    What else it gives is None for a new training, else whether other versions may go on with it.
    """
    with own_random_state(), stop_on_signal() as stop, _environment(recipe, scenario) as environment:
        model = make_model(recipe, environment)
        run, other_versions = begin()
        with only_process(run):
            policy_now = policy_maker(recipe, scenario, observation_for(scenario))
            found = None if other_versions is None else _newest(run, fingerprint(recipe, scenario), other_versions)
            if found is not None and found[0] is not None:
                check_fits(run.checkpoints, found[0], model, policy_now(model))
            session = Session(run, model, recipe, scenario)
            between = BetweenUpdates(
                recipe,
                policy_now,
                save=session.save,
                stop=stop,
                evaluate=evaluate,
                on_progress=on_progress,
            )
            if found is not None:
                session.restore(between, found[0])
                between.notes += [f"a damaged checkpoint was left aside: {reason}" for reason in found[1]]
            status = session.learn(between)
    return Training(run, between.course, status, scheme_of(recipe, scenario), scenario)


def _result(training: Training) -> TrainResult:
    course = training.course
    assert isinstance(course.policy, Policy) and isinstance(course.kept, Policy)  # set before the first rollout
    return TrainResult(
        training.run.path,
        course.kept,
        course.policy,
        training.status,
        course.steps,
        course.updates,
        course.wall_s,
        tuple(course.evaluations),
        tuple(course.alarms),
    )


def _newest(run: RunDirectory, training: str, other_versions: bool) -> tuple[TrainingState | None, list[str]]:
    """The newest whole checkpoint, if there is one, and what was wrong with newer ones."""
    remove_unfinished(run.path)
    if not run.checkpoints.is_dir():
        return None, []
    remove_unfinished(run.checkpoints)
    state, damaged = newest_usable(run.checkpoints)
    if state is not None:
        _check_training(run, state, training, other_versions)
        if not other_versions:
            _check_versions(run, state.versions)
    return state, damaged


def _check_training(run: RunDirectory, state: TrainingState, training: str, other_versions: bool) -> None:
    """Raise ``InvalidInput`` for a checkpoint of another training than ``config.json`` asks for."""
    then, name = state.numbers.get("training"), run.checkpoint(state.steps).name
    if then is None and not other_versions:
        raise InvalidInput(
            f"{run.path}: {name} was written by an earlier version, which does not say of which training it is; go on"
            " all the same with --other-versions"
        )
    if then not in (None, training):
        raise InvalidInput(
            f"{run.config}: was changed after the checkpoint {name} of this training; put it back as it was, or train"
            " again in another folder"
        )


def _check_versions(run: RunDirectory, then: Mapping[str, str]) -> None:
    now = installed_versions()
    for name in sorted(now.keys() | then.keys()):
        if now.get(name) != then.get(name):
            raise InvalidInput(
                f"{run.path}: was trained with {name} {then.get(name)}, here is {now.get(name)}: the numbers would"
                " differ; install that version, or go on all the same with --other-versions"
            )


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
def _environment(recipe: TrainingRecipe, scenario: Scenario) -> Iterator[EthBrakeVecEnv]:
    environment = make_sb3_vec_env(
        scenario,
        recipe.n_envs,
        recipe.seed,
        reward=recipe.reward,
        observation=observation_for(scenario),
        horizon_is_end=recipe.horizon_is_end,
        appended=_APPENDED.get(scheme_of(recipe, scenario)),
    )
    try:
        yield environment
    finally:
        environment.close()
