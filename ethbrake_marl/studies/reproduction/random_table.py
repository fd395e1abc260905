"""The paper's table of the random test: 10,000 worlds, four strategies (``Table:Random``)."""

from __future__ import annotations

from ethbrake_marl.agents.protocol import Agent
from ethbrake_marl.evaluation.paper import PAPER_ROWS, RANDOM_TEST
from ethbrake_marl.policies.shipped import load_shipped
from ethbrake_marl.studies.reproduction.item import (
    Made,
    Parameter,
    Settings,
    Table,
    list_parameter,
    scenario_parameters,
)
from ethbrake_marl.studies.reproduction.measure import (
    ABOUT_POLICIES,
    AS_STATED,
    COUPLED,
    FULL_BRAKE,
    NAMES,
    PAIRWISE,
    READINGS,
    drive_list,
    lineup,
    read_scenario,
)
from ethbrake_marl.studies.reproduction.policies import hybrid
from ethbrake_marl.studies.reproduction.printed import Beside, compare_rows, decrease_verdict, rows_csv, rows_table

SCENARIO = "paper-random"
_WORLDS = 10_000
_KINDS = ("SAC", "PPO")
_BOUNDS = ("coupled", "pairwise")
_ABOUT_H = {"coupled": "realised H*", "pairwise": "predicted H*"}


def hybrid_name(kind: str, bound: str) -> str:
    """Of a hybrid in the table."""
    return f"Hybrid {kind}, {_ABOUT_H[bound]}"


_ROWS = {
    "Non-E": (NAMES[FULL_BRAKE],),
    "E-V2X-BM": (NAMES[PAIRWISE], NAMES[COUPLED]),
    **{f"Hybrid {kind}": tuple(hybrid_name(kind, bound) for bound in _BOUNDS) for kind in _KINDS},
}


def reproduce_random_table(settings: Settings) -> Made:
    """Collisions, harm and its decrease of the four strategies."""
    episodes, besides = settings.worlds(_WORLDS), []
    for reading in READINGS:
        scenario = read_scenario(SCENARIO, reading)
        agents: dict[str, Agent] = dict(lineup((FULL_BRAKE, PAIRWISE, COUPLED), scenario))
        for kind in _KINDS:
            policy = load_shipped(kind.lower())
            agents |= {
                hybrid_name(kind, "coupled"): hybrid(policy, scenario, "coupled"),
                hybrid_name(kind, "pairwise"): hybrid(policy, scenario, "pairwise"),
            }
        besides.append(Beside(reading.name, drive_list(scenario, agents, episodes, settings), _ROWS))
    printed = [row for row in PAPER_ROWS if row.table == RANDOM_TEST]
    verdicts = [*(decrease_verdict(row, printed[0]) for row in printed[1:]), *compare_rows(printed, besides)]
    text = "text to Table:Random"
    parameters = (
        *scenario_parameters(read_scenario(SCENARIO, AS_STATED), gaps_m=text, speeds_mps=text),
        Parameter("policies", f"{ABOUT_POLICIES}; not the paper's", ""),
        Parameter("H*", "realised (ours) and predicted pair by pair (the paper's)", "sec:baseline_drl, Hybrid DRL"),
        Parameter("harm", "each pair's first impact", "sec:result, Experimental Set-Up"),
        list_parameter(episodes, f"10,000, {text}" if episodes == _WORLDS else ""),
    )
    tables = (_printed(), *(rows_table(each) for each in besides))
    return Made(tuple(verdicts), parameters, tables, data={"random-table": rows_csv(besides)})


def _printed() -> Table:
    rows = tuple(
        (row.agent, f"{row.collisions:,}", f"{100.0 * row.collision_rate:g} %", f"{row.average_harm:g}",
         f"{100.0 * (row.harm_decrease or 0.0):g} %")
        for row in PAPER_ROWS
        if row.table == RANDOM_TEST
    )  # fmt: skip
    return Table("The paper's rows, as printed", ("Strategy", "Collisions", "Rate", "Average harm", "Decrease"), rows)
