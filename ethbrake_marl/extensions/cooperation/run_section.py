"""Section of a run's report on several learners: harm of each vehicle, benefit of each learner and of messages."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from ethbrake_marl.agents.learned import TRAINED_TEAM
from ethbrake_marl.agents.protocol import Agent, Driver, Team
from ethbrake_marl.errors import EthBrakeError, InvalidInput, PhysicsError, count_of
from ethbrake_marl.evaluation.evaluation import Evaluation
from ethbrake_marl.evaluation.lineup import make_agents
from ethbrake_marl.evaluation.outcome import Outcome
from ethbrake_marl.evaluation.rollout import evaluate
from ethbrake_marl.evaluation.seeds import share_over_seeds
from ethbrake_marl.evaluation.statistics import Texts, mean, paired_difference
from ethbrake_marl.extensions.cooperation.levels import HARM
from ethbrake_marl.extensions.report.experiment import RunSection
from ethbrake_marl.extensions.search.best_harm import search_list, task_problem
from ethbrake_marl.files.sheet import Column, Row, Sheet
from ethbrake_marl.files.store import write_output
from ethbrake_marl.game.harm import HARM_COUNTS, HarmCount
from ethbrake_marl.physics.state import Floats
from ethbrake_marl.progress import OnProgress, Progress
from ethbrake_marl.scenario.sample import Sample
from ethbrake_marl.scenario.schema import Scenario
from ethbrake_marl.training.experiment import Experiment, without
from ethbrake_marl.training.session import train
from ethbrake_marl.training.team import load_team

SEARCHED = 100  # number of worlds in which the joint optimum is searched

BUDGET = 5_000  # number of candidates that this search tries per world and count of harm

Harms = Mapping[HarmCount, Floats]  # count of harm -> harm of the whole line in each world, [n] m2/s2


class Stopped(Exception):
    """Raised if a training run for the comparisons in the report was interrupted or failed.

    Args:
        told: message that says which training run stopped and why, without a full stop.
        interrupted: name of the training run if Ctrl-C stopped it; an empty text if it failed.

    """

    def __init__(self, told: str, interrupted: str = "") -> None:
        super().__init__(told)
        self.interrupted = interrupted


class Compared(NamedTuple):
    """Harm of the trained team and of another agent in the same worlds."""

    name: str  # name of the other agent
    other: Harms  # harm of the other agent
    team: Harms  # harm of the team
    clusters: Texts | None  # name of each world's cluster (``Evaluation.clusters``)


def make_section(experiment: Experiment, tell: OnProgress) -> RunSection | None:
    """Compare a run's trained team with learners trained alone, a team without messages, and the joint optimum.

    The result is None if the run has only one learner. In each new training run, a learner makes as many decisions as
    in the original run. The new training runs are stored in ``alone/`` and ``without-messages/`` in the folder of the
    run, and the results of the comparison in ``cooperation.json``. If a training run is interrupted or fails, the
    remaining training runs and the search are omitted.
    """
    evaluation, team, by = experiment.evaluation, experiment.learned, experiment.evaluation.clusters
    if team != TRAINED_TEAM:
        return None
    outcomes, note = dict(evaluation.outcomes), "The training was interrupted: nothing more was trained to compare."
    rows: list[Compared] = []
    interrupted = ""
    if experiment.trained.status == "finished":
        try:
            alone = _train_alone(experiment, tell)
            single = evaluate(evaluation.worlds, alone, scenario=evaluation.scenario, aftermath=False).complete()
            outcomes |= single.outcomes
            best = min(alone, key=lambda name: float(outcomes[name].world_harm(experiment.harm_count).mean()))
            rows = [Compared(f"best single learner ({best})", _harms(outcomes[best]), _harms(outcomes[team]), by)]
            silent, why_silent = _without_messages(experiment, tell)
            optimum, why_optimum = _joint_optimum(experiment, outcomes, tell)
            rows += [*silent, *optimum]
            note = f"{why_silent} {why_optimum}"
        except Stopped as stopped:
            note, interrupted = f"{stopped}: nothing more was compared.", stopped.interrupted
    sheets = {f"borne_{each}": _borne(outcomes, each, evaluation) for each in HARM_COUNTS}
    sheets["added"] = _added(experiment)
    if rows:
        sheets |= {f"compared_{each}": _compared(rows, each) for each in HARM_COUNTS}
    content = {name: sheet.json() for name, sheet in sheets.items()} | {"note": note}
    text = json.dumps(content, indent=2, allow_nan=False) + "\n"
    write_output(experiment.run.path / "cooperation.json", text.encode(), force=True)
    return RunSection("Several learners", (*sheets.values(), note), interrupted)


def _train_alone(experiment: Experiment, tell: OnProgress) -> dict[str, Team]:
    """Train each learner alone while the others brake fully; return the resulting teams by name."""
    scenario, policies = experiment.evaluation.scenario, {}
    braking = make_agents(["full_brake"], scenario)["full_brake"]
    for vehicle in scenario.learners:
        name = scenario.vehicle_names[vehicle]
        others = {scenario.vehicle_names[i]: "full_brake" for i in scenario.learners if i != vehicle}
        own = scenario.replace(roles={**scenario.roles, **others})
        team = _train(experiment, own, f"alone/{name}", len(scenario.learners), tell)
        drivers: dict[int, Agent] = dict.fromkeys(scenario.learners, braking)
        policies[f"{name} alone"] = Team(drivers | team.drivers, f"{name} alone")
    return policies


def _without_messages(experiment: Experiment, tell: OnProgress) -> tuple[list[Compared], str]:
    """Train a team with sensors instead of messages; return comparisons with this team, and a sentence about it.

    The list is empty if the scenario has no messages or is a mixture of scenarios, or if such a team cannot be trained
    or compared. The sentence then says why.
    """
    evaluation, scenario = experiment.evaluation, experiment.evaluation.scenario
    if scenario.members or scenario.v2x.channel.hears == "none":
        why = "a mixture" if scenario.members else "a scenario without messages"
        return [], f"What messages add was not measured: this is {why}."
    try:
        silent = scenario.replace(v2x="sensors-only")
        listed = silent.sample(int(evaluation.index.max()) + 1, experiment.list_seed).take(evaluation.index)
    except InvalidInput as error:
        return [], f"What messages add was not measured: {error}."
    pairs = ((getattr(listed.worlds, name), getattr(evaluation.worlds, name)) for name in ("gaps_m", "speeds_mps"))
    rows = np.flatnonzero(np.logical_and.reduce([(one == other).all(axis=1) for one, other in pairs]))
    if not rows.size:
        return [], "What messages add was not measured: without messages no world of the list is the same line."
    agents: dict[str, Driver] = {
        **make_agents(["full_brake"], silent),
        "team": _train(experiment, silent, "without-messages", 1, tell),
    }
    driven = evaluate(listed.take(rows), agents, scenario=silent, aftermath=False).complete()
    ours = _harms(evaluation.outcome(TRAINED_TEAM).take(rows))
    left_out = ", without those in which something is hit before that" if len(rows) < evaluation.worlds.n else ""
    by = evaluation.take(rows).clusters
    rows_of_table = [
        Compared(f"{name} without messages", _harms(driven.outcome(name)), ours, by) for name in ("team", "full_brake")
    ]
    return rows_of_table, (
        "The team without messages is trained and driven with sensors only, which see the next vehicle ahead and"
        f" behind, so that a vehicle may also react later; the lines are the same{left_out}."
    )


def _joint_optimum(
    experiment: Experiment, outcomes: Mapping[str, Outcome], tell: OnProgress
) -> tuple[list[Compared], str]:
    """Search the joint optimum; return a list that compares it with the team, and a sentence about the search.

    If the search is impossible, the list is empty, and the sentence says why.
    """
    evaluation = experiment.evaluation
    rows = np.arange(min(SEARCHED, evaluation.worlds.n))
    part = Sample(evaluation.worlds.take(rows), evaluation.index[rows], 0)

    def told(done: int, total: int) -> None:
        tell(Progress("joint optimum", done, total))

    try:
        told(0, len(rows))
        table = search_list(evaluation.scenario, part, budget=BUDGET, on_progress=told)
    except (InvalidInput, PhysicsError) as error:
        return [], f"The joint optimum was not searched: {error}."
    identity = task_problem(part.worlds, evaluation.task).identity
    best, shares, by = {}, [], evaluation.take(rows).clusters
    for harm_count in HARM_COUNTS:
        harms = [outcome.take(rows).world_harm(harm_count) for outcome in outcomes.values()]
        best[harm_count] = np.fmin.reduce([table.harm(identity, harm_count), *harms])
        ours, worst = (outcomes[name].take(rows).world_harm(harm_count) for name in (TRAINED_TEAM, "full_brake"))
        share = share_over_seeds(ours[np.newaxis], worst[np.newaxis], best[harm_count][np.newaxis], clusters=by)
        if share is not None and share.value >= 0.0:
            reached = share.in_words(digits=0, scale=100.0, unit=" %")
            shares.append(f"{reached} of the possible reduction of {HARM[harm_count]}")
    return [Compared("joint optimum", best, _harms(outcomes[TRAINED_TEAM].take(rows)), by)], (
        f"The joint optimum is the least harm known that these learners can do together, from a search of {BUDGET:,}"
        f" candidates per world in the first {count_of(len(rows), 'world')}"
        + (f"; the team reaches {' and '.join(shares)}." if shares else ".")
    )


def _train(experiment: Experiment, scenario: Scenario, folder: str, share: int, tell: OnProgress) -> Team:
    """Train the learners of ``scenario`` with the recipe of the run; return the trained team.

    The new run is stored in ``folder`` inside the folder of the finished run, and makes 1 / ``share`` of the decisions
    of the finished run. Raises ``Stopped`` if the new run was interrupted or failed.
    """
    recipe, path = experiment.trained.training.recipe, experiment.run.path / folder
    path.parent.mkdir(exist_ok=True)

    def told(progress: Progress) -> None:
        tell(replace(progress, name=f"{folder}: {progress.name}"))

    turns = {"turns": None} if getattr(recipe, "turns", None) else {}
    kept = recipe if share == 1 else recipe.replace(scheme=None, **turns)
    try:
        result = train(kept, scenario, path, steps=max(recipe.total_steps // share, 1), on_progress=told)
    except EthBrakeError as error:
        raise Stopped(f"The training run in {folder} failed ({error})") from error
    if result.status == "interrupted":
        raise Stopped(f"The training run in {folder} was interrupted", f"the training run in {folder}")
    return load_team(path, scenario, folder)


def _harms(outcome: Outcome) -> Harms:
    return {harm_count: outcome.world_harm(harm_count) for harm_count in HARM_COUNTS}


def _compared(rows: list[Compared], harm_count: HarmCount) -> Sheet:
    """Return a table that compares the harm of the trained team with the harm of each agent in ``rows``."""
    columns = [
        Column("Compared with", "with", text=True),
        Column("Worlds", "worlds", digits=0),
        Column("Its harm", "its", interval="hidden"),
        Column("The team's", "team", interval="hidden"),
        Column("The team's minus its", "difference", sign="+"),
    ]
    cells: list[Row] = []
    for name, other, team, by in rows:
        ours, its = team[harm_count], other[harm_count]
        cells.append((name, len(ours), mean(its, by), mean(ours, by), paired_difference(ours, its, by)))
    return Sheet(f"The trained team compared: {HARM[harm_count]}, mean per world (m²/s²)", columns, cells)


def _borne(outcomes: Mapping[str, Outcome], harm_count: HarmCount, evaluation: Evaluation) -> Sheet:
    """Return a table of the mean harm that each vehicle bears, with one row for each agent."""
    scenario, by = evaluation.scenario, evaluation.clusters
    names = [name.replace("_", " ").capitalize() for name in scenario.vehicle_names]
    learn = ", ".join(names[i] for i in scenario.learners)
    columns = [Column("Agent", "agent", text=True)]
    for heading, key in zip((*names, "Whole line"), (*scenario.vehicle_names, "line"), strict=True):
        columns.append(Column(heading, key, interval="hidden"))
    rows: list[Row] = []
    for agent, outcome in outcomes.items():
        each = outcome.vehicle_harm(harm_count).T
        rows.append((agent, *(mean(harm, by) for harm in each), mean(outcome.world_harm(harm_count), by)))
    return Sheet(f"Who bears what: {HARM[harm_count]}, mean per world (m²/s²)", columns, rows, f"{learn} learn.")


def _added(experiment: Experiment) -> Sheet:
    """Return a table of the harm that each learner of the team prevents.

    This is (harm of the line if this learner brakes fully) - (harm of the line with the whole team).
    """
    evaluation, scenario = experiment.evaluation, experiment.evaluation.scenario
    columns = [Column("Learner", "learner", text=True)]
    columns += [Column(f"More {HARM[each]} without it", f"{each}_added", sign="+") for each in HARM_COUNTS]
    rows: list[Row] = []
    for vehicle in scenario.learners:
        name = scenario.vehicle_names[vehicle]
        less, team = _harms(evaluation.outcome(without(name))), _harms(evaluation.outcome(TRAINED_TEAM))
        rows.append((name, *(paired_difference(less[each], team[each], evaluation.clusters) for each in HARM_COUNTS)))
    about = "The same team, but that vehicle brakes fully; the others were not trained for that."
    return Sheet("What each learner adds, mean per world (m²/s²)", columns, rows, about)
