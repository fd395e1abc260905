"""Tables of a run with several learners: harm that each vehicle bears, and harm that each learner prevents."""

from __future__ import annotations

from ethbrake_marl.files.sheet import Column, Row, Sheet
from ethbrake_marl.first_edition.agents.learned import TRAINED_TEAM
from ethbrake_marl.first_edition.evaluation.evaluation import Evaluation
from ethbrake_marl.first_edition.evaluation.statistics import mean, paired_difference
from ethbrake_marl.first_edition.game.harm import HARM_COUNTS, HarmCount
from ethbrake_marl.first_edition.training.experiment import without

_HARM = {"first": "first-impact harm", "total": "total harm"}


def learners_sheets(evaluation: Evaluation) -> list[Sheet]:
    """Return the tables of a trained team's evaluation: who bears what under each count, and what each learner adds."""
    return [*(_borne(evaluation, harm_count) for harm_count in HARM_COUNTS), _added(evaluation)]


def _borne(evaluation: Evaluation, harm_count: HarmCount) -> Sheet:
    """Return a table of the mean harm that each vehicle bears, with one row for each agent."""
    scenario, by = evaluation.scenario, evaluation.clusters
    names = [name.replace("_", " ").capitalize() for name in scenario.vehicle_names]
    learn = ", ".join(names[i] for i in scenario.learners)
    columns = [Column("Agent", "agent", text=True)]
    columns += [Column(heading, interval="hidden") for heading in (*names, "Whole line")]
    rows: list[Row] = []
    for agent, outcome in evaluation.outcomes.items():
        each = outcome.vehicle_harm(harm_count).T
        rows.append((agent, *(mean(harm, by) for harm in each), mean(outcome.world_harm(harm_count), by)))
    return Sheet(f"Who bears what: {_HARM[harm_count]}, mean per world (m²/s²)", columns, rows, f"{learn} learn.")


def _added(evaluation: Evaluation) -> Sheet:
    """Return a table of the harm that each learner of the team prevents.

    This is (harm of the line if this learner brakes fully) - (harm of the line with the whole team).
    """
    scenario, team = evaluation.scenario, evaluation.outcome(TRAINED_TEAM)
    columns = [Column("Learner", text=True)]
    columns += [Column(f"More {_HARM[each]} without it", sign="+") for each in HARM_COUNTS]
    rows: list[Row] = []
    for name in (scenario.vehicle_names[i] for i in scenario.learners):
        less = evaluation.outcome(without(name))
        pairs = ((less.world_harm(each), team.world_harm(each)) for each in HARM_COUNTS)
        rows.append((name, *(paired_difference(one, other, evaluation.clusters) for one, other in pairs)))
    about = "The same team, but that vehicle brakes fully; the others were not trained for that."
    return Sheet("What each learner adds, mean per world (m²/s²)", columns, rows, about)
