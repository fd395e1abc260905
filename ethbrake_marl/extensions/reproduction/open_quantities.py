"""Sensitivity of the random test's results to the quantities that the paper leaves open.

One table states what the paper says about each of these quantities, our default, and alternative values. Another table
states, for each alternative value, how much the mean harm changes, and the new collision rates.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np

from ethbrake_marl.extensions.report.paper_rows import PAPER_ROWS
from ethbrake_marl.extensions.reproduction.figures import changes_figure
from ethbrake_marl.extensions.reproduction.folder import (
    POLICIES,
    Drawn,
    Made,
    Parameter,
    Reproduction,
    csv_text,
    list_parameter,
    scenario_parameters,
)
from ethbrake_marl.extensions.reproduction.hybrid import RANDOM
from ethbrake_marl.extensions.reproduction.strategies import COUPLED, FULL_BRAKE, NAMES, PAIRWISE, PPO, hybrid, lineup
from ethbrake_marl.extensions.reproduction.tables import collision_rate
from ethbrake_marl.extensions.reproduction.trainings import HARM_COLUMN, OPEN, PPO_PAPER
from ethbrake_marl.extensions.reproduction.verdicts import HARM, LIST_SEED, PERCENT, Less, Verdict, compare_number
from ethbrake_marl.files.sheet import Estimate, Sheet
from ethbrake_marl.first_edition.agents.protocol import Agent
from ethbrake_marl.first_edition.evaluation.rollout import evaluate
from ethbrake_marl.first_edition.evaluation.statistics import mean, paired_difference
from ethbrake_marl.first_edition.physics.state import Bools, Floats
from ethbrake_marl.first_edition.policies.shipped import load_shipped
from ethbrake_marl.first_edition.scenario.catalogue import load_scenario
from ethbrake_marl.first_edition.scenario.schema import Scenario
from ethbrake_marl.first_edition.training.recipe import load_recipe
from ethbrake_marl.first_edition.training.run_folder import RunDirectory
from ethbrake_marl.progress import Progress


@dataclass(frozen=True, slots=True, eq=False)
class Alternative:
    """Alternative value of a quantity, and how to repeat the random test with this value."""

    value: str  # the value in words
    changes: Mapping[str, Any] = field(default_factory=dict)  # keys of the scenario with their new values
    seed: int | None = None  # seed of the evaluation list; None: the usual seed
    # Count of harm: ``first`` (first impacts), ``total`` (all impacts), ``sampled`` (the paper's sum over samples), or
    # ``predicted`` (the harm that E-V2X-BM predicts).
    harm: Literal["first", "total", "sampled", "predicted"] = "first"
    # None: PPO drives. ``coupled`` or ``pairwise``: the paper's hybrid of PPO and E-V2X-BM replaces PPO. The hybrid
    # obtains H*, the harm of E-V2X-BM, from a simulation (``coupled``) or from a closed form (``pairwise``).
    bound: Literal["coupled", "pairwise"] | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Gap:
    """A quantity that the paper does not state, or states ambiguously."""

    name: str  # name of the quantity
    paper: str  # what the paper says about the quantity, with the label of the place in the paper's source
    ours: str  # our default value
    alternatives: tuple[Alternative, ...] = ()  # other values with which the random test is repeated
    otherwise: str = ""  # reason why there are no alternatives; empty if there are some


def _of(key: str, *values: float, unit: str = "") -> tuple[Alternative, ...]:
    return tuple(Alternative(f"{value:g}{unit}", {key: value}) for value in values)


GAPS = (
    Gap("restitution e", "eq:12: e in [0, 1], typically at most 0.3; not said for its tests", "0.1",
        _of("restitution", 0.0, 0.2, 0.3, 0.5)),
    Gap("time step Δt", "sec:optimization_problem: a sampling period, no number", "0.1 s",
        _of("time_step_s", 0.05, 0.2, unit=" s")),
    Gap("impacts at samples or exact", "dynamics2: at samples", "at their exact time; each impact once",
        (Alternative("the paper's map at 0.1 s, harm at every sample of an overlap (eq:Jharmn)", harm="sampled"),)),
    Gap("horizon N", "Jfunc: N steps, no number", "8 s", _of("horizon_s", 5.0, 16.0, unit=" s")),
    Gap("largest speed v_max", "eq:52: a limit, no number", "40 m/s", _of("speed_limit_mps", 25.0, unit=" m/s")),
    Gap("when Vehicle 2 may act", "text to Fig:Harm-ivds: τ2 = 0.5 s", "0.5 s",
        (Alternative("0.2 s", {"latency_s": [0, 0.2, 0.8]}), Alternative("0.3 s", {"latency_s": [0, 0.3, 0.8]}))),
    Gap("what the latency of Vehicle 3 is counted from", "eq:olle2: from t = 0", "from t = 0",
        (Alternative("from τ2 (τ3 = 1.3 s)", {"latency_s": [0, 0.5, 1.3]}),)),
    Gap("which impacts count", "sec:result: each pairwise collision once; eq:Jharmn: at every sample",
        "each pair's first impact", (Alternative("every impact", harm="total"),)),
    Gap("H* of E-V2X-BM, predicted or realised", "Eq:BaselineHarm: the expected harm", "realised; both are shown",
        (Alternative("predicted, pair by pair", harm="predicted"),)),
    Gap("H* inside the hybrid", "alg:hybrid: H* of Eq:BaselineHarm", "realised (coupled)",
        (Alternative("hybrid with realised H*", bound="coupled"),
         Alternative("hybrid with predicted H*", bound="pairwise"))),
    Gap("initial speeds of Table:hybrid", "identical simulation settings; only gaps are named", "18 to 22 m/s",
        (Alternative("20, 18, 20 m/s", {"speeds_mps": [20, 18, 20]}),)),
    Gap("seed of the test", "text to Table:hybrid: a fixed random seed", "7",
        (Alternative("8", seed=8), Alternative("9", seed=9))),
    Gap("impacts before Vehicle 2 may act", "sec:system_model: assumed not to happen", "such worlds are drawn again",
        (Alternative("kept", {"early_impacts": "keep"}),)),
    Gap("what Vehicle 1 brakes for", "sec:problem: an unforeseen obstacle, not modelled", "nothing ahead",
        (Alternative("an obstacle 1.7 m beyond its stopping point", {"obstacle_margin_m": 1.7}),)),
    Gap("may Vehicle 2 drive", "text to Fig:Harm-ivds: yes, a_u,2 = 7 m/s²; E-V2X-BM only brakes", "yes",
        (Alternative("no, brake and coast only", {"driving_capacity_mps2": [6, 0, 6]}),)),
    Gap("Vehicles 1 and 3 after an impact", "eq:olle1, eq:olle2: brake for a time fixed by the initial speeds",
        "brake until they stand",
        otherwise="not measured: the engine has no vehicle that rolls on after its braking time"),
    Gap("weights of the reward", "w_h, w_p, w_j, R_safe, k_energy, k_d, d_safe, d_target: none stated",
        "1, 0.1, 1e-5, 10 in ppo-paper", otherwise="trained by --full: ppo-paper-..."),
    Gap("state of the policy", "MDP formulation: positions, speeds, actions of the others",
        "also capacities, masses, latencies, e and derived features",
        otherwise="trained by --full: ppo-paper-state..."),
    Gap("seeds of the training", "multiple training tests with different random seeds", "0, 1, 2",
        otherwise="trained by --full: ppo-paper..."),
    Gap("ends of the cosine, number of decisions", "table:params: cosine, no numbers", "3e-4 to 3e-5; in the recipes",
        otherwise="not measured: one training each takes minutes; docs/train.md compares recipes"),
)  # fmt: skip

_SPECS = (FULL_BRAKE, PAIRWISE, COUPLED, PPO)

_SHOWN = tuple(NAMES[spec] for spec in _SPECS)


@dataclass(frozen=True, slots=True)
class Headline:
    """Harm and collisions of each strategy in n worlds."""

    gaps_m: Floats  # [n, P] gaps at the alert (m), which show whether two results are for the same worlds
    harm: Mapping[str, Floats]  # strategy -> [n] harm in each world (m2/s2)
    collided: Mapping[str, Bools]  # strategy -> [n] whether each world has a collision

    def change(self, base: Headline, strategy: str) -> Estimate:
        """Return the mean harm of ``strategy`` minus its mean harm in ``base``, m2/s2.

        If both objects are for the same worlds, the difference is computed world by world.
        """
        own, other = self.harm[strategy], base.harm[strategy]
        if np.array_equal(self.gaps_m, base.gaps_m):
            return paired_difference(own, other)
        return Less.of_lists(strategy, own, other).difference


def reproduce_gaps(settings: Reproduction) -> Made:
    """Measure how results of the random test change if a quantity that the paper leaves open gets another value.

    One table lists all such quantities (``GAPS``).
    """
    episodes, scenario = min(2_000, settings.episodes), load_scenario(RANDOM)
    base = _measure(scenario, Alternative("default"), episodes)
    measured = [gap for gap in GAPS if gap.alternatives]
    headlines: dict[tuple[Gap, Alternative], Headline] = {}
    for number, gap in enumerate(measured):
        settings.tell(Progress("open quantities", number, len(measured)))
        headlines |= {(gap, each): _measure(scenario, each, episodes) for each in gap.alternatives}
    settings.tell(Progress("open quantities", len(measured), len(measured)))
    rows = {f"{gap.name}: {each.value}": headline for (gap, each), headline in headlines.items()}
    changes = {row: {name: headline.change(base, name) for name in _SHOWN} for row, headline in rows.items()}
    verdicts, notes, printed = [], [], {row.agent: row for row in PAPER_ROWS if row.table == "random test"}
    for agent, spec in (("Non-E", FULL_BRAKE), ("E-V2X-BM", PAIRWISE), ("Hybrid PPO", PPO)):
        others = {row: mean(headline.harm[NAMES[spec]]) for row, headline in rows.items()}
        what = f"{agent}, average harm of Table:Random, one open quantity changed at a time"
        ours = mean(base.harm[NAMES[spec]])
        verdicts.append(compare_number(what, printed[agent].average_harm, ours, others=others))
    order = (NAMES[PPO], NAMES[COUPLED], NAMES[FULL_BRAKE])
    means = {row: [float(headline.harm[name].mean()) for name in order] for row, headline in rows.items()}
    broken = [row for row, in_order in means.items() if in_order != sorted(in_order)]
    stays = f"in {len(rows) - len(broken)} of {len(rows)} alternatives{'; not with ' * bool(broken)}{'; '.join(broken)}"
    verdicts.append(Verdict(f"the order stays: {' < '.join(order)}", "differs" if broken else "agrees", stays))
    for name in _SHOWN:
        most = max(rows, key=lambda row: abs(changes[row][name].value))
        harm = mean(base.harm[name]).in_words()
        notes.append(f"What moves {name} ({harm}) most: {most}, by {changes[most][name].in_words()}.")
    tables = [
        Sheet(
            "Register of what the paper leaves open",
            ("Quantity", "The paper", "Our default", "Alternatives, or why none is measured"),
            [
                (gap.name, gap.paper, gap.ours, "; ".join(each.value for each in gap.alternatives) or gap.otherwise)
                for gap in GAPS
            ],
            "Labels are those of the paper's source.",
        ),
        Sheet(
            "Headline at our defaults",
            ("Strategy", PERCENT, HARM),
            [(name, collision_rate(base.collided[name]), mean(base.harm[name])) for name in _SHOWN],
            f"{episodes:,} worlds of the random test, seed {LIST_SEED}; first-impact harm, m²/s²; 95 % intervals.",
        ),
        Sheet(
            "How far the headline moves",
            [
                *("Quantity", "Default", "Alternative", *_SHOWN),
                *(replace(PERCENT, heading=f"Collisions, {name}") for name in ("E-V2X-BM", "PPO")),
            ],
            [
                (
                    *(gap.name, gap.ours, each.value, *(headline.change(base, name) for name in _SHOWN)),
                    *(collision_rate(headline.collided[NAMES[spec]]).value for spec in (PAIRWISE, PPO)),
                )
                for (gap, each), headline in headlines.items()
            ],
            "Change of the mean harm (m²/s²) with its 95 % interval, paired by world where the worlds are the same;"
            " then the collision rates in the alternative. In the rows of H* inside the hybrid, PPO stands behind"
            " Algorithm 1.",
        ),
    ]
    trained = {
        name.partition("/")[2]: [min(RunDirectory(path).column(HARM_COLUMN).values()) for path in paths]
        for name, paths in settings.trained([OPEN]).items()
    }
    if trained:
        note = (
            "First-impact harm (m²/s²) of the kept policy on 1,000 worlds of seed 1007; ppo-paper is the paper's table"
            f" with our weights. Each had {PPO_PAPER.decisions:,} of the recipe's"
            f" {load_recipe(PPO_PAPER.recipe).total_steps:,} decisions; two seeds say little about others."
        )
        conditions = [
            (name, len(policy), float(np.mean(policy)), ", ".join(f"{harm:.2f}" for harm in policy))
            for name, policy in trained.items()
        ]
        tables.append(
            Sheet("What is open in training", ("Training", "Seeds", "Mean harm", "Each seed"), conditions, note)
        )
    else:
        verdicts.append(Verdict("what is open in training", "not run", "no training; --full trains"))
    data = [
        (row, name, len(each.gaps_m), mean(each.harm[name]).value, each.change(base, name),
         collision_rate(each.collided[name]).value)
        for row, each in {"default": base, **rows}.items()
        for name in _SHOWN
    ]  # fmt: skip
    head = ("alternative", "strategy", "worlds", "harm", "change", "change_low", "change_high", "collision_rate")
    about = "Change of the mean harm of each strategy on the random test when one open quantity changes."
    figure = changes_figure(changes, x_label="Change of the mean harm (m²/s²)", caption=about)
    parameters = [
        *scenario_parameters(scenario, gaps_m="text to Table:Random", speeds_mps="text to Table:Random"),
        Parameter("policies", f"{POLICIES}; not trained anew for an alternative"),
        list_parameter(episodes),
    ]
    drawn = Drawn("gaps", "How far the headline moves", about)
    return Made(verdicts, parameters, tables, {drawn: figure}, {"gaps": csv_text(head, data)}, notes)


def _measure(scenario: Scenario, alternative: Alternative, episodes: int) -> Headline:
    """Evaluate the strategies in the random test with an alternative value of a quantity.

    ``scenario`` is the scenario before ``alternative.changes`` are applied. If ``alternative.harm`` is ``predicted``,
    only the pairwise E-V2X-BM has predicted harm; for the other strategies, first-impact harm is returned.
    """
    own = scenario.replace(**alternative.changes) if alternative.changes else scenario
    agents: dict[str, Agent] = lineup(own, *_SPECS)
    if alternative.bound is not None:
        agents[NAMES[PPO]] = hybrid(load_shipped("ppo"), own, alternative.bound)
    seed = LIST_SEED if alternative.seed is None else alternative.seed
    evaluation = evaluate(
        own.sample(episodes, seed), agents, scenario=own, seed=seed, aftermath=alternative.harm == "sampled"
    )
    harm = {}
    for name, outcome in evaluation.outcomes.items():
        predicted = outcome.predicted_harm if name == NAMES[PAIRWISE] else None
        counted = {"total": outcome.total_harm, "sampled": outcome.sampled_harm, "predicted": predicted}
        chosen = counted.get(alternative.harm)
        harm[name] = outcome.first_impact_harm if chosen is None else chosen
    collided = {name: outcome.collided for name, outcome in evaluation.outcomes.items()}
    return Headline(evaluation.worlds.gaps_m, harm, collided)
