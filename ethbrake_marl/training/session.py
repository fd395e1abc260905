"""Train, or resume a training: build the model, learn, evaluate, save."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from ethbrake_marl.errors import InvalidInput, Progress, Told, stop_on_signal
from ethbrake_marl.files.store import hold_lock, read_object, remove_unfinished
from ethbrake_marl.policies.manifest import installed_versions
from ethbrake_marl.policies.policy import Policy
from ethbrake_marl.policies.teams import Trained
from ethbrake_marl.registry import versions_used
from ethbrake_marl.scenario.schema import Scenario
from ethbrake_marl.training.checkpoint import TrainingState, newest_usable
from ethbrake_marl.training.fixed_list import Measure, measure_on_list
from ethbrake_marl.training.models import make_environment, make_model
from ethbrake_marl.training.random_state import own_random_state
from ethbrake_marl.training.recipe import Scheme, TrainingRecipe
from ethbrake_marl.training.run_folder import RunDirectory
from ethbrake_marl.training.stretch import Ended, Session, StopAt, Wishes
from ethbrake_marl.training.training import Training, recorded_training


@dataclass(frozen=True, slots=True)
class TrainResult:
    """What a training left behind.

    ``trained`` is of the moment of least harm on the fixed list, or of the end where nothing was measured.

    >>> import ethbrake_marl as eb
    >>> short = {"n_envs": 8, "n_steps": 16, "batch_size": 64, "n_epochs": 1}
    >>> recipe = eb.load_recipe("ppo").replace(**short, network={"policy": [8], "value": [8]})
    >>> result = eb.train(recipe, "paper-random", "runs/example", steps=128, measure=None)
    >>> result.status, result.steps, result.policy.manifest.algorithm
    ('finished', 128, 'ppo')

    """

    directory: Path  # the run's folder
    training: Training  # recipe, scenario and what they come to
    trained: Trained  # one policy for all learners, or one for each; also saved as directory/policy
    last: Trained  # of the end; also saved as directory/policy-last
    status: Ended  # finished or interrupted
    steps: int  # decisions of all learners, a multiple of rows x rounds
    updates: int  # rounds of collecting and learning
    wall_s: float  # s, of all stretches together
    evaluations: tuple[Mapping[str, float], ...]  # what was measured on the way, in order

    @property
    def policies(self) -> dict[str, Policy]:
        """Vehicle -> the policy that drives it."""
        return dict(self.trained.drivers)

    @property
    def policy(self) -> Policy:
        """The policy that drives all learners; raises ``InvalidInput`` where each has its own."""
        return _only(self.trained)

    @property
    def last_policy(self) -> Policy:
        """The same of the training's end."""
        return _only(self.last)


def _only(trained: Trained) -> Policy:
    if isinstance(trained, Policy):
        return trained
    raise InvalidInput(f"training: {', '.join(trained.drivers)} have a policy each; take one of policies")


def train(
    recipe: TrainingRecipe | str | Path,
    scenario: Scenario | str | Path,
    directory: str | Path,
    *,
    scheme: Scheme | None = None,
    turns: int | None = None,
    seed: int | None = None,
    steps: int | None = None,
    force: bool = False,
    settings: Sequence[str] = (),
    measure: Measure | None = measure_on_list,
    stop_at: StopAt | None = None,
    on_progress: Told = "show",
) -> TrainResult:
    """Train the learners of ``scenario`` into the new ``directory``.

    Ctrl-C stops after the update in progress (status ``interrupted``); a second one raises ``KeyboardInterrupt``.
    Whatever ends it but a kill, ``policy/`` holds the best policy so far and ``policy-last/`` the last good one;
    ``resume`` goes on. The same recipe, scenario, seed and machine give the same policy, bit for bit; global random
    states are left as they were.

    Args:
        recipe: a recipe, its name, or the path of its file.
        scenario: a scenario, its name, or the path of its file; its roles say who learns.
        directory: the run's folder.
        scheme: overrides the recipe's; without any, one learner is ``single`` and several are ``shared``.
        turns: overrides the recipe's, of independent learners (docs/training-schemes.md).
        seed: overrides the recipe's.
        steps: overrides the recipe's decisions of learners; training ends after the first update at or beyond them.
        force: replace an earlier run.
        settings: by which recipe and scenario differ from their files, ``KEY=VALUE`` each: noted in ``config.json``.
        measure: makes of the training what measures its policies before the first update, then as the recipe says, and
            at the end: by default on the recipe's fixed list. None: nothing is measured.
        stop_at: is given every evaluation, as it stands in ``TrainResult.evaluations``, and gives a reason to stop
            there, ``interrupted``, or None.
        on_progress: is told how far the training is; by default stderr shows it, None: nobody is told.

    Raises ``AlreadyExists`` for an existing directory without ``force``, ``InvalidInput`` where recipe and scenario do
    not fit each other, ``TrainingDiverged`` for numbers that are not finite.

    """
    changes = {"scheme": scheme, "turns": turns, "seed": seed, "total_steps": steps}
    training = Training.of(recipe, scenario, **{name: value for name, value in changes.items() if value is not None})
    run = RunDirectory(Path(directory))
    begin = partial(run.create, training.config(settings), team=training.team(), force=force)
    return _run(run, begin, training, Wishes(measure, stop_at, Progress.listener(on_progress)))


def resume(
    directory: str | Path,
    *,
    measure: Measure | None = measure_on_list,
    stop_at: StopAt | None = None,
    on_progress: Told = "show",
    other_versions: bool = False,
) -> TrainResult:
    """Go on with a training that was stopped or killed, to the policies that it would have come to: the same bits.

    It goes on from the newest checkpoint that is whole, or from the beginning when there is none; rows and events after
    that checkpoint are dropped, so that nothing stands twice.

    Args:
        directory: the run's folder.
        measure: as it was given to ``train``.
        stop_at: as it was given to ``train``; it hears of new evaluations only.
        on_progress: is told how far the training is; by default stderr shows it, None: nobody is told.
        other_versions: go on from a checkpoint that other versions wrote, although its numbers may differ.

    Raises ``InvalidInput`` for a folder without a training, one that has finished, one in which another process trains,
    one whose ``config.json`` was edited since the checkpoint, and a checkpoint of other versions.

    """
    run = RunDirectory(Path(directory))
    config = run.read_config()
    training = recorded_training(run, config)
    status = read_object(run.status)
    resumable = any(run.checkpoints.glob("step_*"))
    if status["status"] == "finished" or (status.get("stage") is not None and not resumable):  # its report may be open
        alone = len(training.drivers) == 1
        agents = f"{training.recipe.algorithm}@{directory}+episode" if alone else f"team@{directory}"
        raise InvalidInput(
            f"{directory}: this training has finished; measure what it has learned with: ethbrake evaluate --scenario"
            f" {training.scenario.name} --agents {agents}"
        )

    begin = partial(run.write_json, run.team, training.team())  # a damaged one would stay
    wishes = Wishes(measure, stop_at, Progress.listener(on_progress))
    return _run(run, begin, training, wishes, partial(_newest, run, training.identity, other_versions))


def _run(
    run: RunDirectory,
    begin: Callable[[], object],
    training: Training,
    wishes: Wishes,
    find: Callable[[], tuple[TrainingState | None, list[str]]] = lambda: (None, []),
) -> TrainResult:
    """Train in the folder that ``begin`` makes or mends, once nothing can be wrong with environment and model.

    ``find`` gives the checkpoint to go on from, if there is one, and why newer ones are not whole.
    """
    evaluate = None if wishes.measure is None else wishes.measure(training)
    algorithm = training.recipe.make_algorithm()
    with own_random_state(), stop_on_signal() as stop, closing(make_environment(training)) as environment:
        model = make_model(algorithm, training, environment)
        begin()
        with hold_lock(run.lock, "another process is training here"):
            state, damaged = find()
            session = Session(run, training, algorithm, model, wishes, evaluate, stop)
            if state is not None:
                session.restore(state)
            if state is None and training.begins is not None:
                session.notes.append(f"begins with {training.begins}")
            session.notes += [f"a damaged checkpoint was left aside: {reason}" for reason in damaged]
            status = session.learn(state)
    course = session.course
    assert course.policy is not None and course.kept is not None  # set before the first rollout
    return TrainResult(
        run.path, training, course.kept, course.policy, status, course.steps, course.updates, course.wall_s,
        tuple(course.evaluations),
    )  # fmt: skip


def _newest(run: RunDirectory, training: str, other_versions: bool) -> tuple[TrainingState | None, list[str]]:
    """The newest whole checkpoint, if there is one, and what was wrong with newer ones."""
    remove_unfinished(run.path)
    if run.checkpoints.is_dir():
        remove_unfinished(run.checkpoints)
    state, damaged = newest_usable(run.checkpoints)
    if state is None:
        return None, damaged
    if state.numbers.get("training") != training:
        name = run.checkpoint(state.steps).name
        raise InvalidInput(
            f"{run.config}: was changed after the checkpoint {name} of this training; put it back as it was, or"
            " train again in another folder"
        )
    now, then = installed_versions(), state.numbers["versions"]
    asked = then.keys() | (now.keys() - versions_used().keys())  # other parts may have been loaded here since
    other = sorted(name for name in asked if now.get(name) != then.get(name))
    if other and not other_versions:
        name = other[0]
        raise InvalidInput(
            f"{run.path}: was trained with {name} {then.get(name)}, here is {now.get(name)}: the numbers would"
            " differ; install that version, or go on all the same with --other-versions"
        )
    return state, damaged
