"""The main experiment: train, then compare the trained policy, its shield and the baselines in the same worlds."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple, Protocol

from ethbrake_marl.agent_names import teams_of
from ethbrake_marl.agents.scripts import FULL_BRAKE
from ethbrake_marl.agents.team import Team
from ethbrake_marl.episode.counts import HarmCount
from ethbrake_marl.errors import EthBrakeError, InvalidInput
from ethbrake_marl.evaluation.comparison import Comparison
from ethbrake_marl.evaluation.evaluate import EPISODES, SEED, evaluate
from ethbrake_marl.evaluation.measure_registry import MEASURES
from ethbrake_marl.evaluation.results import RESULTS, write_results
from ethbrake_marl.progress import OnProgress, Progress
from ethbrake_marl.training.recipe import TrainingRecipe
from ethbrake_marl.training.run import RunFolder
from ethbrake_marl.training.train import TrainResult, train
from ethbrake_marl.worlds.physics import departures_by
from ethbrake_marl.worlds.scenario import Scenario

BASELINES = ("full_brake", "e_v2x_bm", "e_v2x_bm:pairwise")
TEAM_BASELINES = BASELINES[:2]  # the closed form is for one learner
POLICY, HYBRID = "trained policy", "hybrid"  # names of what one learner learned, alone and in the paper's hybrid
TEAM, SHIELDED = "trained team", "shielded team"  # names of what several learned, alone and with the step shield


class Experiment(NamedTuple):
    trained: TrainResult
    compared: Comparison
    measures: tuple[str, ...]  # names of the measures beside the usual ones
    started: float  # ``time.monotonic`` at the start (s)

    @property
    def learned(self) -> str:
        return POLICY if POLICY in self.compared.teams else TEAM

    def in_another(
        self, scenario: Scenario, episodes: int, baselines: Sequence[str], measures: Sequence[str]
    ) -> Comparison:
        count = self.compared.harm_count
        teams = compared_teams(self.trained, scenario, count, baselines)
        seed = self.compared.result.about["seed"]
        return Comparison.of(scenario, teams, episodes=episodes, seed=seed, harm_count=count, measures=measures)


class ReportWriter(Protocol):
    measures: tuple[str, ...]  # names of the measures that it can show; those that no package has are left out

    def write(self, experiment: Experiment, tell: OnProgress) -> tuple[Sequence[Any], str]:
        """Returns the tables to print, and a text that says where the report is."""


class Tables:
    measures: tuple[str, ...] = ("pushed_m",)

    def write(self, experiment: Experiment, tell: OnProgress) -> tuple[Sequence[Any], str]:
        return experiment.compared.table.tables(), f"results: {experiment.trained.directory / RESULTS}"


def run_experiment(
    recipe: TrainingRecipe,
    scenario: Scenario,
    directory: Path,
    *,
    train_on: Scenario | None = None,
    steps: int | None = None,
    seed: int | None = None,
    episodes: int = EPISODES,
    list_seed: int = SEED,
    force: bool = False,
    settings: Sequence[str] = (),
    report: ReportWriter | None = None,
    on_progress: OnProgress | None = None,
    on_unwritten: Callable[[OSError | EthBrakeError], None] | None = None,
) -> tuple[Experiment, Sequence[Any], str]:
    """Train, compare, and write ``results.json``, ``worlds.csv`` and a report into the run's folder.

    ``train_on``: scenario of the training; None: ``scenario``, in which the agents are compared. Optimising agents
    minimise the count of harm used in training (``reward.harm_count``). ``on_unwritten`` is called if results or report
    cannot be written; None: the error is raised. Other arguments and errors are as in ``train`` and ``evaluate``.

    Raises ``InvalidInput`` at once for a scenario without exact impacts, which shields and reports need.
    """
    if departures_by(scenario.physics):
        raise InvalidInput(
            f"scenario {scenario.name!r}: ethbrake run compares shields, which need exact impacts, and physics:"
            f" {scenario.physics} has none; use ethbrake train and ethbrake evaluate"
        )
    started, tell = time.monotonic(), on_progress or (lambda progress: None)
    writer: ReportWriter = report or Tables()
    count = recipe.reward.harm_count
    test_in_world = partial(evaluate, scenario, episodes=1, seed=list_seed, harm_count=count)
    test_on_list = partial(evaluate, scenario, FULL_BRAKE.name, episodes=episodes, seed=list_seed)
    baselines = usable("baselines", TEAM_BASELINES if len(scenario.learners) > 1 else BASELINES, test_in_world, tell)
    installed = [name for name in writer.measures if name in MEASURES]
    measures = tuple(usable("measures", installed, lambda name: test_on_list(measures=name), tell))
    trained = train(
        recipe, train_on or scenario, directory, steps=steps, seed=seed, force=force, settings=settings,
        on_progress=on_progress,
    )  # fmt: skip
    experiment = None
    try:
        with RunFolder(trained.directory).stage("evaluation", trained.status):
            note = ""
            if trained.status == "interrupted":
                note = (
                    f"training interrupted after {trained.steps:,} steps; now evaluating the policy so far (press"
                    " Ctrl-C again to stop immediately)"
                )
            tell(Progress("evaluation", 0, episodes, note=note))
            compared = Comparison.of(
                scenario, compared_teams(trained, scenario, count, baselines), episodes=episodes, seed=list_seed,
                harm_count=count, measures=measures,
                on_done=lambda worlds: tell(Progress("evaluation", worlds, episodes)),
            )  # fmt: skip
            experiment = Experiment(trained, compared, measures, started)
            write_results(trained.directory, compared.table, compared.result, "csv", force=True)
            tables, where = writer.write(experiment, tell)
    except (OSError, EthBrakeError) as error:
        if experiment is None or on_unwritten is None:
            raise
        on_unwritten(error)
        tables, where = experiment.compared.table.tables(), f"policy: {trained.directory}"
    return experiment, tables, where


def usable(what: str, names: Sequence[str], use: Callable[[str], object], tell: OnProgress) -> list[str]:
    """Names for which ``use`` raises no ``InvalidInput``. ``tell`` is called with the error of every other name.

    The error of ``full_brake`` is raised.
    """
    usable_names = []
    for number, name in enumerate(names):
        try:
            use(name)
            usable_names.append(name)
        except InvalidInput as error:
            if name == FULL_BRAKE.name:
                raise
            tell(Progress(what, number, len(names), note=f"{name} is left out: {error}"))
    return usable_names


def compared_teams(
    trained: TrainResult, scenario: Scenario, count: HarmCount, baselines: Sequence[str]
) -> Mapping[str, Team]:
    """Teams to compare: the baselines, then the trained policies without and with a shield.

    With several learners, there is one more team for each learner, in which this learner brakes fully.
    """
    agents: dict[str, Any] = {name: name for name in baselines}
    if len(trained.policies) == 1:
        agents |= {POLICY: trained.agent, HYBRID: f"{trained.agent}+episode"}
    else:
        specs = {vehicle: f"policy@{trained.directory / place}" for vehicle, place in trained.training.drivers.items()}
        agents[TEAM] = specs
        agents |= {without(vehicle): {**specs, vehicle: FULL_BRAKE.name} for vehicle in specs}
        agents[SHIELDED] = f"{trained.agent}+step"
    return teams_of(agents, scenario, harm_count=count)


def without(vehicle: str) -> str:
    return f"all but {vehicle}"
