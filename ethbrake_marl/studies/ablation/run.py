"""Training everything that an ablation needs: finished trainings are kept, begun ones go on, several at once."""

from __future__ import annotations

import os
import threading
from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass, field, replace
from functools import partial
from multiprocessing import active_children, get_context, parent_process
from multiprocessing.process import BaseProcess
from typing import Any

import numpy as np

from ethbrake_marl.agents.team import Team
from ethbrake_marl.evaluation.identity import policies_by_name, result_identity
from ethbrake_marl.evaluation.inputs import PROGRESS_EVERY
from ethbrake_marl.evaluation.outcome import Outcome
from ethbrake_marl.evaluation.rollout import evaluate
from ethbrake_marl.files.plugins import Plugin, load_the_same, loaded_plugins
from ethbrake_marl.harm import HARM_COUNTS, HarmCount
from ethbrake_marl.learning.run_folder import RunDirectory
from ethbrake_marl.learning.team_file import load_team
from ethbrake_marl.learning.train import resume, train
from ethbrake_marl.physics import Bools, Floats
from ethbrake_marl.progress import OnProgress, Progress
from ethbrake_marl.scenario import Sample, Scenario
from ethbrake_marl.studies.ablation.joint_optimum import LevelOptimum, best_known, search_all
from ethbrake_marl.studies.ablation.plan import Level, Plan, Training, common_worlds


def train_all(trainings: Sequence[Training], jobs: int, tell: OnProgress | None = None) -> bool:
    """Bring every training to its end, ``jobs`` at a time; False when Ctrl-C stopped it.

    The policies do not depend on ``jobs`` or on interruptions. Raises what ``Training.steps_left`` and ``train``
    raise.
    """
    left = [training for training in trainings if training.steps_left()]
    say = tell or (lambda progress: None)
    if jobs == 1 or len(left) < 2:
        return all(_train(training, partial(_tell, say, training.folder.name)) for training in left)
    plugins, spawn = loaded_plugins(), get_context("spawn")
    load_the_same(plugins)  # a file that was changed since is told here, in one line
    with ProcessPoolExecutor(jobs, mp_context=spawn, initializer=_begin_worker, initargs=(plugins,)) as pool:
        futures = [pool.submit(_train, training) for training in left]
        say(Progress("trainings", 0, len(left)))
        try:
            for done, future in enumerate(as_completed(futures)):
                if not future.result():
                    raise KeyboardInterrupt
                say(Progress("trainings", done + 1, len(left)))
        except KeyboardInterrupt:
            pool.shutdown(wait=False, cancel_futures=True)
            for worker in active_children():
                worker.terminate()  # a training ends after its update, with a checkpoint
            return False
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise
    return True


def check_finished(trainings: Iterable[Training]) -> None:
    """Raise what ``load_team`` raises for a finished training that cannot drive, before anything long is begun."""
    for training in trainings:
        if not training.steps_left():
            load_team(training.folder, training.level.scenario)


def _begin_worker(plugins: Sequence[Plugin]) -> None:
    """Leave Ctrl-C to the parent, which passes it on once, end with the parent however that ends; load its plug-ins."""
    os.setpgrp()
    parent = parent_process()
    assert parent is not None
    threading.Thread(target=_end_with, args=(parent,), daemon=True).start()
    load_the_same(plugins)


def _end_with(parent: BaseProcess) -> None:
    parent.join()
    os._exit(1)


def _train(training: Training, tell: OnProgress | None = None) -> bool:
    """Whether it is finished now."""
    if RunDirectory(training.folder).status.is_file():
        return resume(training.folder, on_progress=tell).status == "finished"
    training.folder.parent.mkdir(parents=True, exist_ok=True)
    result = train(training.recipe, training.level.scenario, training.folder, settings=training.noted, on_progress=tell)
    return result.status == "finished"


def _tell(tell: OnProgress, name: str, progress: Progress) -> None:
    tell(Progress(name, progress.done, progress.total))


@dataclass(frozen=True, slots=True)
class Harms:
    """What several trainings (or one script) did, on the same worlds."""

    world: dict[HarmCount, Floats]  # [seeds, worlds] harm of all vehicles (m2/s2)
    vehicle: dict[HarmCount, Floats]  # [seeds, worlds, N] harm of each
    collided: Bools  # [seeds, worlds]
    policies: tuple[Mapping[str, str], ...] = ()  # of each seed: vehicle -> SHA-256 of its policy's manifest


@dataclass(frozen=True, slots=True)
class Measured:
    """One level under one algorithm."""

    level: Level
    algorithm: str | None  # None: nobody learns
    reached: Harms
    full_brake: Harms  # of all vehicles, whatever their roles
    best: dict[HarmCount, Floats] | None  # [1, search_episodes] joint optimum, best known; None: nobody to control
    identity: Mapping[str, Any] = field(default_factory=dict)  # of worlds and scenario, and what computed it


def load_teams(plan: Plan) -> dict[tuple[str, str], list[Team]]:
    """What was trained, by level and algorithm, seed by seed; raises what ``load_team`` raises."""
    teams: dict[tuple[str, str], list[Team]] = {}
    for training in plan.trainings():
        team = load_team(training.folder, training.level.scenario, training.folder.name)
        teams.setdefault((training.level.name, training.algorithm), []).append(team)
    return teams


def measure(plan: Plan, jobs: int = 1, tell: OnProgress | None = None) -> list[Measured]:
    """Let everything that was trained drive the common worlds, and search the joint optima (parts found are kept).

    Level by level in the plan's order, algorithm by algorithm. What some policy does better than the search becomes
    the best known of that world. Raises what loading teams and ``common_worlds`` raise, before any long work.
    """
    say = tell or (lambda progress: None)
    teams = load_teams(plan)
    samples = common_worlds(plan.levels, plan.episodes, plan.list_seed)
    tables = search_all(plan, samples, jobs, say)
    answers = {}
    for level, sample in zip(plan.levels, samples, strict=True):
        if level.trained:
            own = [team for algorithm in plan.algorithms for team in teams[level.name, algorithm]]
            part = sample.worlds.take(np.arange(plan.search_episodes))
            answers[level.name] = LevelOptimum(level, part, tables[level.name], tuple(own))
    found: list[Measured] = []
    for level, sample in zip(plan.levels, samples, strict=True):
        braking = _drive(_all_brake(level.scenario), sample, [Team({}, f"full braking in {level.name}")], say)
        about = result_identity("ablate", level.scenario, sample)
        if not level.trained:
            scripts = _drive(level.scenario, sample, [Team({}, f"scripts of {level.name}")], say)
            found.append(Measured(level, None, scripts, braking, None, about))
            continue
        known = best_known(answers[level.name], list(answers.values()))
        best = {harm_count: harm[np.newaxis] for harm_count, harm in known.items()}
        for algorithm in plan.algorithms:
            reached = _drive(level.scenario, sample, teams[level.name, algorithm], say)
            found.append(Measured(level, algorithm, reached, braking, best, about))
    return found


def _all_brake(scenario: Scenario) -> Scenario:
    """The scenario with every vehicle braking fully."""
    return scenario.replace(roles=dict.fromkeys(scenario.vehicle_names, "full_brake"))


def _drive(scenario: Scenario, sample: Sample, teams: Sequence[Team], tell: OnProgress) -> Harms:
    """Harms of several teams of one level."""
    outcomes = []
    for team in teams:
        result = evaluate(sample, {team.name: team}, scenario=scenario, chunk=PROGRESS_EVERY).complete()
        outcomes.append(result.outcome(team.name))
        tell(Progress(f"driving {team.name}", sample.worlds.n, sample.worlds.n))
    policies = tuple(policies_by_name(outcome.policies, scenario) for outcome in outcomes)
    return replace(harms_of(outcomes), policies=policies)


def harms_of(outcomes: Sequence[Outcome]) -> Harms:
    """The outcomes of several seeds on the same worlds, stacked."""
    return Harms(
        {harm_count: np.stack([o.ledger.world_harm(harm_count) for o in outcomes]) for harm_count in HARM_COUNTS},
        {harm_count: np.stack([o.ledger.vehicle_harm(harm_count) for o in outcomes]) for harm_count in HARM_COUNTS},
        np.stack([o.collided for o in outcomes]),
    )
