"""The paper's hybrid around a policy that has not converged: ``Fig:hybrid illu`` and ``Table:hybrid``."""

from __future__ import annotations

import numpy as np

from ethbrake_marl.agents.policy import LearnedAgent
from ethbrake_marl.agents.protocol import Agent
from ethbrake_marl.evaluation import Evaluation
from ethbrake_marl.evaluation.outcome import HYBRID_TEST, PAPER_ROWS, RANDOM_TEST, PaperRow
from ethbrake_marl.evaluation.statistics import mean
from ethbrake_marl.policies.shipped import load_shipped
from ethbrake_marl.studies.reproduction.item import (
    ABOUT_POLICIES,
    AGREES,
    AS_STATED,
    COUPLED,
    DIFFERS,
    FULL_BRAKE,
    HARM,
    NAMES,
    PAIRWISE,
    PREDICTED,
    READINGS,
    Beside,
    Grouped,
    Made,
    Parameter,
    Reading,
    Settings,
    Table,
    Verdict,
    compare_rows,
    decrease_verdict,
    drive_list,
    group_by_distance,
    judge_statement,
    lineup,
    list_parameter,
    read_scenario,
    rows_csv,
    rows_table,
    scenario_parameters,
    selection_verdict,
)
from ethbrake_marl.studies.reproduction.trainings import Unconverged, hybrid, unconverged_policy
from ethbrake_marl.studies.reproduction.two_scenarios import distance_csv, distance_figure, distance_table

ALONE, HYBRID, AS_PRINTED = "policy alone", "hybrid, realised H*", "hybrid, predicted H*"
_FIGURE, _TABLE = "paper-distance", "paper-random"
_WORLDS = 5_000


_NOT_THEIRS = (
    "The paper does not describe its policy that has not converged. The rows of Standalone DRL and Hybrid are of ours:"
    " whether they agree depends on when a training is stopped."
)


def reproduce_illustration(settings: Settings) -> Made:
    """Harm of E-V2X-BM, of a policy that has not converged, and of the hybrid, over the total distance."""
    episodes, chosen = settings.worlds(_WORLDS), unconverged_policy(settings)
    found: dict[Reading, Grouped] = {}
    verdicts = []
    for reading in READINGS:
        evaluation = _drive(_FIGURE, reading, chosen, settings)
        found[reading] = group_by_distance(evaluation)
        verdicts += _judge_choice(reading, evaluation, found[reading])
    parameters = (
        *scenario_parameters(read_scenario(_FIGURE, AS_STATED), gaps_m="5 to 10 m, text to Table:hybrid"),
        *_about(chosen),
        list_parameter(episodes),
    )
    lines = [NAMES[PAIRWISE], NAMES[COUPLED], ALONE, HYBRID, AS_PRINTED, PREDICTED]
    drawn = distance_figure("hybrid-illustration", found, lines, episodes)
    tables = tuple(distance_table(reading.name, grouped) for reading, grouped in found.items())
    return Made(tuple(verdicts), parameters, tables, (drawn,), {"hybrid-illustration": distance_csv(found)})


def reproduce_hybrid_table(settings: Settings) -> Made:
    """The 5,000 episodes of the paper's table, with both speeds that it may mean."""
    episodes, chosen = settings.worlds(_WORLDS), unconverged_policy(settings)
    beside: list[Beside] = []
    for name, speeds in ((_TABLE, "speeds 18 to 22 m/s"), (_FIGURE, "speeds 20, 18, 20 m/s")):
        for reading in READINGS:
            evaluation = _drive(name, reading, chosen, settings)
            beside.append(Beside(f"{speeds}, {reading.name}", evaluation, _ROWS))
    printed = [row for row in PAPER_ROWS if row.table == HYBRID_TEST]
    scenario = read_scenario(_TABLE, AS_STATED)
    both = "uniform (18, 22) m/s, the random test's, and (20, 18, 20) m/s, the figure's"
    parameters = (
        *(
            Parameter("speeds", both, "") if each.name == "speeds" else each
            for each in scenario_parameters(scenario, gaps_m="text to Table:hybrid", latency_s="identical settings")
        ),
        *_about(chosen),
        list_parameter(episodes, "5,000, text to Table:hybrid" if episodes == _WORLDS else ""),
    )
    return Made(
        (selection_verdict(_printed("E-V2X-BM"), _printed("Standalone DRL"), _printed("Hybrid")),
         *compare_rows(printed, beside)),
        parameters,
        (_printed_table(printed), *(rows_table(each) for each in beside)),
        data={"hybrid-table": rows_csv(beside)},
        notes=(_NOT_THEIRS,),
    )  # fmt: skip


# Which of ours stands beside which row of the paper; the first is compared with the printed number.
_ROWS = {
    "E-V2X-BM": (NAMES[PAIRWISE], NAMES[COUPLED]),
    "Standalone DRL": (ALONE,),
    "Hybrid": (AS_PRINTED, HYBRID),
}


def _printed(agent: str) -> PaperRow:
    return next(row for row in PAPER_ROWS if row.table == HYBRID_TEST and row.agent == agent)


def _printed_table(printed: list[PaperRow]) -> Table:
    rows = tuple(
        (row.agent, f"{row.collisions:,}", f"{100.0 * row.collision_rate:g} %", f"{row.average_harm:g}")
        for row in printed
    )
    return Table("The paper's rows, as printed", ("Strategy", "Collisions", "Rate", "Average harm"), rows)


def _about(chosen: Unconverged) -> tuple[Parameter, ...]:
    return (
        Parameter("policy", chosen.about, ""),
        Parameter("H*", "realised (ours) and predicted pair by pair (the paper's)", "sec:baseline_drl, Hybrid DRL"),
        Parameter("harm", "each pair's first impact", "sec:result, Experimental Set-Up"),
    )


def _drive(name: str, reading: Reading, chosen: Unconverged, settings: Settings) -> Evaluation:
    """The strategies on the worlds of a scenario; figure and table share those of the figure."""
    scenario = read_scenario(name, reading)
    agents: dict[str, Agent] = {
        **lineup((PAIRWISE, COUPLED), scenario),
        ALONE: LearnedAgent(chosen.policy, "policy"),
        HYBRID: hybrid(chosen.policy, scenario, "coupled"),
        AS_PRINTED: hybrid(chosen.policy, scenario, "pairwise"),
    }
    key = ("hybrid", name, reading.name, chosen.about)
    return settings.once(key, lambda: drive_list(scenario, agents, settings.worlds(_WORLDS), settings))


def _judge_choice(reading: Reading, evaluation: Evaluation, grouped: Grouped) -> list[Verdict]:
    """Whether it "consistently selects the strategy that results in lower harm": in each world, in each group."""
    harm = {name: outcome.first_impact_harm for name, outcome in evaluation.outcomes.items()}
    verdicts = []
    for name, baseline in ((HYBRID, NAMES[COUPLED]), (AS_PRINTED, NAMES[PAIRWISE])):
        lower = np.minimum(harm[ALONE], harm[baseline])
        worse = harm[name] > lower + 1e-9
        excess = mean(harm[name] - lower)
        told = (
            f"in {int(worse.sum()):,} of {len(worse):,} worlds the {name} harms more than the lower of policy and"
            f" {baseline}; mean excess {HARM.estimate(excess)}"
        )
        outcome = DIFFERS if worse.any() else AGREES
        verdicts.append(Verdict(f"the {name} takes the lower of the two ({reading.name})", outcome, told))
    for other in (ALONE, NAMES[COUPLED]):
        what = f"the {HYBRID} harms no more than {other} at every distance ({reading.name})"
        verdicts.append(judge_statement(what, grouped.less(HYBRID, other), or_equal=True))
    return verdicts


# The paper's table of the random test: 10,000 worlds, four strategies (``Table:Random``).

SCENARIO = "paper-random"
_RANDOM_WORLDS = 10_000
_KINDS = ("SAC", "PPO")
_BOUNDS = ("coupled", "pairwise")
_ABOUT_H = {"coupled": "realised H*", "pairwise": "predicted H*"}


def hybrid_name(kind: str, bound: str) -> str:
    """Of a hybrid in the table."""
    return f"Hybrid {kind}, {_ABOUT_H[bound]}"


_RANDOM_ROWS = {
    "Non-E": (NAMES[FULL_BRAKE],),
    "E-V2X-BM": (NAMES[PAIRWISE], NAMES[COUPLED]),
    **{f"Hybrid {kind}": tuple(hybrid_name(kind, bound) for bound in _BOUNDS) for kind in _KINDS},
}


def reproduce_random_table(settings: Settings) -> Made:
    """Collisions, harm and its decrease of the four strategies."""
    episodes, besides = settings.worlds(_RANDOM_WORLDS), []
    for reading in READINGS:
        scenario = read_scenario(SCENARIO, reading)
        agents: dict[str, Agent] = dict(lineup((FULL_BRAKE, PAIRWISE, COUPLED), scenario))
        for kind in _KINDS:
            policy = load_shipped(kind.lower())
            agents |= {
                hybrid_name(kind, "coupled"): hybrid(policy, scenario, "coupled"),
                hybrid_name(kind, "pairwise"): hybrid(policy, scenario, "pairwise"),
            }
        besides.append(Beside(reading.name, drive_list(scenario, agents, episodes, settings), _RANDOM_ROWS))
    printed = [row for row in PAPER_ROWS if row.table == RANDOM_TEST]
    verdicts = [*(decrease_verdict(row, printed[0]) for row in printed[1:]), *compare_rows(printed, besides)]
    text = "text to Table:Random"
    parameters = (
        *scenario_parameters(read_scenario(SCENARIO, AS_STATED), gaps_m=text, speeds_mps=text),
        Parameter("policies", f"{ABOUT_POLICIES}; not the paper's", ""),
        Parameter("H*", "realised (ours) and predicted pair by pair (the paper's)", "sec:baseline_drl, Hybrid DRL"),
        Parameter("harm", "each pair's first impact", "sec:result, Experimental Set-Up"),
        list_parameter(episodes, f"10,000, {text}" if episodes == _RANDOM_WORLDS else ""),
    )
    tables = (_random_printed(), *(rows_table(each) for each in besides))
    return Made(tuple(verdicts), parameters, tables, data={"random-table": rows_csv(besides)})


def _random_printed() -> Table:
    rows = tuple(
        (row.agent, f"{row.collisions:,}", f"{100.0 * row.collision_rate:g} %", f"{row.average_harm:g}",
         f"{100.0 * (row.harm_decrease or 0.0):g} %")
        for row in PAPER_ROWS
        if row.table == RANDOM_TEST
    )  # fmt: skip
    return Table("The paper's rows, as printed", ("Strategy", "Collisions", "Rate", "Average harm", "Decrease"), rows)
