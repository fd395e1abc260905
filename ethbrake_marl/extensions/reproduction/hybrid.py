"""Reproduce the paper's results on its hybrid, and on random worlds.

In the paper's source, the results on the hybrid have the labels ``Fig:hybrid illu`` and ``Table:hybrid``; the results
on random worlds have the label ``Table:Random``.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from ethbrake_marl.extensions.report.paper_rows import PAPER_ROWS
from ethbrake_marl.extensions.reproduction.folder import (
    FIRST_IMPACTS,
    H_STAR,
    NOT_THEIRS,
    Made,
    Parameter,
    Reproduction,
    list_parameter,
    scenario_parameters,
)
from ethbrake_marl.extensions.reproduction.groups import DISTANCE, by_distance, less_in_each, over_distance
from ethbrake_marl.extensions.reproduction.strategies import (
    COUPLED,
    FULL_BRAKE,
    NAMES,
    PAIRWISE,
    READINGS,
    Reading,
    drive_list,
    harms,
    hybrid,
    lineup,
    unconverged_policy,
)
from ethbrake_marl.extensions.reproduction.tables import Beside, beside_printed, decrease_verdict, selection_verdict
from ethbrake_marl.extensions.reproduction.verdicts import PREDICTED, Verdict, judge_statement
from ethbrake_marl.first_edition.agents.learned import LearnedAgent
from ethbrake_marl.first_edition.agents.protocol import Agent
from ethbrake_marl.first_edition.evaluation.evaluation import Evaluation
from ethbrake_marl.first_edition.evaluation.statistics import mean
from ethbrake_marl.first_edition.policies.shipped import load_shipped
from ethbrake_marl.first_edition.scenario.catalogue import load_scenario

RANDOM, _HYBRID_WORLDS, _RANDOM_WORLDS, _KINDS = "paper-random", 5_000, 10_000, ("SAC", "PPO")

_ALONE, _REALISED, _AS_PRINTED = "policy alone", "hybrid, realised H*", "hybrid, predicted H*"


def _drive_hybrid(name: str, settings: Reproduction, reading: Reading) -> Evaluation:
    """Evaluate E-V2X-BM, a policy that has not converged, and the paper's hybrid of the two in a shipped scenario."""
    return _driven_hybrid(name, settings, reading, unconverged_policy(settings)[1])


@lru_cache(maxsize=2 * len(READINGS))  # figure and table share the evaluations
def _driven_hybrid(name: str, settings: Reproduction, reading: Reading, about: str) -> Evaluation:
    """Return the evaluation that ``_drive_hybrid`` describes, from the cache if possible.

    ``about``, the description of the policy that has not converged, is part of the cache key: it changes when a trained
    policy replaces the shipped policy, and the strategies are then evaluated again.
    """
    scenario, (policy, _) = reading.scenario(name), unconverged_policy(settings)
    agents: dict[str, Agent] = {
        **lineup(scenario, PAIRWISE, COUPLED),
        _ALONE: LearnedAgent(policy, "policy"),
        _REALISED: hybrid(policy, scenario, "coupled"),
        _AS_PRINTED: hybrid(policy, scenario, "pairwise"),
    }
    return drive_list(scenario, agents, min(_HYBRID_WORLDS, settings.episodes), settings)


def reproduce_illustration(settings: Reproduction) -> Made:
    """Reproduce the paper's illustration of its hybrid.

    The figure shows the harm of E-V2X-BM, of a policy that has not converged, and of the hybrid of the two, against the
    sum of the two gaps. The paper says that the hybrid "consistently selects the strategy that results in lower harm".
    The verdicts check in each world, and in groups of worlds, whether the hybrid does no more harm than either of the
    two.
    """
    curves, verdicts = {}, []
    for reading in READINGS:
        evaluation = _drive_hybrid(DISTANCE, settings, reading)
        curves[reading.name], harm = by_distance(evaluation), harms(evaluation)
        for name, baseline in ((_REALISED, NAMES[COUPLED]), (_AS_PRINTED, NAMES[PAIRWISE])):
            lower = np.minimum(harm[_ALONE], harm[baseline])
            worse = harm[name] > lower + 1e-9
            because = (
                f"in {int(worse.sum()):,} of {len(worse):,} worlds the {name} harms more than the lower of policy and"
                f" {baseline}; mean excess {mean(harm[name] - lower).in_words()}"
            )
            what = f"the {name} takes the lower of the two ({reading.name})"
            verdicts.append(Verdict(what, "differs" if worse.any() else "agrees", because))
        for other in (_ALONE, NAMES[COUPLED]):
            what = f"the {_REALISED} harms no more than {other} at every distance ({reading.name})"
            parts = less_in_each(curves[reading.name][1], _REALISED, other)
            verdicts.append(judge_statement(what, parts, or_equal=True))
    lines = [NAMES[PAIRWISE], NAMES[COUPLED], _ALONE, _REALISED, _AS_PRINTED, PREDICTED]
    parameters = [Parameter("policy", unconverged_policy(settings)[1]), H_STAR, FIRST_IMPACTS]
    episodes = min(_HYBRID_WORLDS, settings.episodes)
    return over_distance("hybrid-illustration", curves, verdicts, lines, parameters, episodes)


def reproduce_hybrid_table(settings: Reproduction) -> Made:
    """Reproduce the paper's table of 5,000 episodes (``Table:hybrid``).

    The paper has two sets of initial speeds, and does not say which of them this table uses, so we compute both.
    """
    ours = {
        "E-V2X-BM": (NAMES[PAIRWISE], NAMES[COUPLED]),
        "Standalone DRL": (_ALONE,),
        "Hybrid": (_AS_PRINTED, _REALISED),
    }
    besides = [
        Beside(f"{speeds}, {reading.name}", _drive_hybrid(name, settings, reading), ours)
        for name, speeds in ((RANDOM, "speeds 18 to 22 m/s"), (DISTANCE, "speeds 20, 18, 20 m/s"))
        for reading in READINGS
    ]
    printed = {row.agent: row for row in PAPER_ROWS if row.table == "hybrid test"}
    episodes = min(_HYBRID_WORLDS, settings.episodes)
    both = "uniform (18, 22) m/s, the random test's, and (20, 18, 20) m/s, the figure's"
    conditions = scenario_parameters(
        load_scenario(RANDOM), gaps_m="text to Table:hybrid", latency_s="identical settings"
    )
    parameters = [
        *(Parameter("speeds", both) if each.name == "speeds" else each for each in conditions),
        Parameter("policy", unconverged_policy(settings)[1]),
        H_STAR,
        FIRST_IMPACTS,
        list_parameter(episodes, "5,000, text to Table:hybrid" if episodes == _HYBRID_WORLDS else ""),
    ]
    arithmetic = [selection_verdict(*(printed[agent] for agent in ours))]
    note = (
        "The paper does not describe its policy that has not converged. The rows of Standalone DRL and Hybrid are of"
        " ours: whether they agree depends on when a training is stopped."
    )
    return beside_printed("hybrid-table", list(printed.values()), besides, arithmetic, parameters, [note])


def reproduce_random_table(settings: Reproduction) -> Made:
    """Reproduce the paper's table of the random test (``Table:Random``)."""
    episodes, besides = min(_RANDOM_WORLDS, settings.episodes), []
    ours: dict[str, tuple[str, ...]] = {
        "Non-E": (NAMES[FULL_BRAKE],),
        "E-V2X-BM": (NAMES[PAIRWISE], NAMES[COUPLED]),
        **{
            f"Hybrid {kind}": (f"Hybrid {kind}, realised H*", f"Hybrid {kind}, predicted H*") for kind in ("SAC", "PPO")
        },
    }
    for reading in READINGS:
        scenario = reading.scenario(RANDOM)
        agents: dict[str, Agent] = lineup(scenario, FULL_BRAKE, PAIRWISE, COUPLED)
        for kind in _KINDS:
            policy, (realised, predicted) = load_shipped(kind.lower()), ours[f"Hybrid {kind}"]
            agents |= {realised: hybrid(policy, scenario, "coupled"), predicted: hybrid(policy, scenario, "pairwise")}
        besides.append(Beside(reading.name, drive_list(scenario, agents, episodes, settings), ours))
    baseline, *others = printed = [row for row in PAPER_ROWS if row.table == "random test"]
    text = "text to Table:Random"
    parameters = [
        *scenario_parameters(load_scenario(RANDOM), gaps_m=text, speeds_mps=text),
        NOT_THEIRS,
        H_STAR,
        FIRST_IMPACTS,
        list_parameter(episodes, f"10,000, {text}" if episodes == _RANDOM_WORLDS else ""),
    ]
    arithmetic = [decrease_verdict(row, baseline) for row in others]
    return beside_printed("random-table", printed, besides, arithmetic, parameters)
