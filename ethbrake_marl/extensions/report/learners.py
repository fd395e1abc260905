"""Tables of a run with several learners: who bears the harm, and what each learner adds."""

from __future__ import annotations

from ethbrake_marl.episode.counts import COLUMN, HARM, IN_WORDS
from ethbrake_marl.evaluation.compared import Compared
from ethbrake_marl.evaluation.statistics import difference, mean
from ethbrake_marl.files.sheet import Column, Row, Sheet
from ethbrake_marl.training.experiment import TEAM, without


def learners_sheets(compared: Compared) -> list[Sheet]:
    return [*(_borne(compared, count) for count in _counts(compared)), _added(compared)]


def _counts(compared: Compared) -> list[str]:
    return [*dict.fromkeys([*HARM, compared.harm_count])]


def _borne(compared: Compared, count: str) -> Sheet:
    scenario, by = compared.scenario, compared.result.clusters
    names = [name.replace("_", " ").capitalize() for name in scenario.vehicle_names]
    columns = [Column("Agent", "agent", text=True)]
    columns += [Column(heading, interval="hidden") for heading in (*names, "Whole line")]
    endings = [*(f"_{i + 1}" for i in range(len(names))), ""]
    rows: list[Row] = [
        (agent, *(mean(own[COLUMN[count] + ending], by) for ending in endings))
        for agent, own in compared.result.columns.items()
    ]
    learn = ", ".join(names[body - 1] for body in scenario.learners)
    return Sheet(f"Who bears what: {IN_WORDS[count]}, mean per world (m²/s²)", columns, rows, f"{learn} learn.")


def _added(compared: Compared) -> Sheet:
    result, counts, rows = compared.result, _counts(compared), list[Row]()
    for name in (compared.scenario.vehicle_names[body - 1] for body in compared.scenario.learners):
        pairs = ((result[without(name)][COLUMN[count]], result[TEAM][COLUMN[count]]) for count in counts)
        rows.append((name, *(difference(less, whole, result.clusters) for less, whole in pairs)))
    columns = [Column("Learner", text=True)]
    columns += [Column(IN_WORDS[count].capitalize(), sign="+") for count in counts]
    about = (
        "How much more harm there is without it: the vehicle brakes fully, and the others were not trained for that."
    )
    return Sheet("What each learner adds, mean per world (m²/s²)", columns, rows, about)
