"""Compare the paper's tables (``Table:hybrid``, ``Table:Random``) and its two contributions with our results."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import get_args

import numpy as np

from ethbrake_marl.evaluation.statistics import decrease, mean, rate, unpaired_difference
from ethbrake_marl.extensions.reproduction.learning import RANDOM, courses_of, judge_trained, unconverged_policy
from ethbrake_marl.extensions.reproduction.made import DRIVERS, Made, ReproductionSettings
from ethbrake_marl.extensions.reproduction.map_bound import collides_in_map
from ethbrake_marl.extensions.reproduction.paper_rows import HYBRID_TEST, RANDOM_TEST, PaperRow
from ethbrake_marl.extensions.reproduction.random_test import (
    E_V2X_BM,
    NON_E,
    PLANS,
    ROUNDING,
    SHIPPED_SPECS,
    WORLD_FIELDS,
    RandomOutcome,
    avoided_text,
    brake,
    drive_all,
    plan,
    report_outcome,
)
from ethbrake_marl.extensions.reproduction.readings import NEAREST, STATED, Reading, Star
from ethbrake_marl.extensions.reproduction.strategies import (
    COUPLED,
    MAP_STEP_S,
    PAPERS,
    PREDICTED,
    above_bound,
    process_outcomes,
    proven_least_harm,
    strategies,
)
from ethbrake_marl.extensions.reproduction.verdicts import (
    HARM,
    PERCENT,
    Claim,
    Less,
    Verdict,
    chance_difference,
    judge,
    judge_number,
    judge_share,
)
from ethbrake_marl.files.sheet import Column, Estimate, Sheet
from ethbrake_marl.motion.layout import Bools, Floats

RATE, AVERAGE, DECREASE = "collision rate", "average harm", "harm decrease"  # that the paper prints
SHOW: Mapping[str, Column] = {RATE: PERCENT, AVERAGE: HARM, DECREASE: PERCENT}
STANDALONE = "Standalone DRL"
HARMS = {"first": "first-impact harm", "total": "total harm"}
SCALES = {**{count: (harm, 1.0) for count, harm in HARMS.items()}, "collided": ("% of worlds", 100.0)}
STOPPED_WORLDS = 5_000
GRADIENT = "vine-paper"  # shipped policy, trained by the algorithm ``vine``

UNCONVERGED = STANDALONE, "Hybrid"  # rows of a policy that has not converged; where ours stops is our choice
MAP_WORLDS, MAP_STEPS_S = 250, (0.1, 0.2, 0.25, 0.3)  # of the bound in the paper's map

ReportedRows = Mapping[str, tuple[Bools, Floats]]  # row of the paper -> collided, harm (m2/s2), [n] each


def table_estimate(quantity: str, row: tuple[Bools, Floats], braking: tuple[Bools, Floats]) -> Estimate:
    if quantity == RATE:
        return rate(row[0])
    saved = decrease(row[1], braking[1]) if quantity == DECREASE else None
    return mean(row[1]) if saved is None else saved


def reported_as(agent: str, quantity: str) -> str:
    """In words."""
    if agent == E_V2X_BM:
        return " (what happens)" if quantity == RATE else " (predicted)"
    return " (policy alone)" if agent.startswith("Hybrid") else ""


def number_claims(
    printed: Sequence[PaperRow],
    stated: ReportedRows,
    nearest: ReportedRows,
    least: Floats,
    in_map: Mapping[str, Estimate],
) -> list[Claim]:
    """Verdict on every number that the paper prints in a table.

    ``least``: proven lower bound on the harm with the parameters as stated and exact impacts, [n] m2/s2. ``in_map``:
    least collision rates in the paper's map, by time step. A number "cannot be" if the bounds for exact impacts and for
    each time step of the map are above it; no bound on harm holds in the map. A row of a policy that has not converged
    is "undecided", unless the bounds decide it.
    """
    claims, exact = [], {RATE: rate(least > 0.0), AVERAGE: mean(least)}
    bounds = exact[RATE], *in_map.values()
    weakest = {RATE: min(bounds, key=lambda bound: bound.value - chance_difference(bound))}
    map_rates = ", ".join(f"{PERCENT.show(bound).in_words} (steps of {step})" for step, bound in in_map.items())
    for row in printed:
        numbers = {RATE: row.collision_rate, AVERAGE: row.average_harm, DECREASE: row.harm_decrease}
        for quantity, number in numbers.items():
            if not number:  # not printed, or the decrease of the baseline itself
                continue
            show = SHOW[quantity]
            our_estimate, nearest_estimate = (
                table_estimate(quantity, outcomes[row.agent], outcomes[NON_E]) for outcomes in (stated, nearest)
            )
            verdict = judge_number(number, our_estimate, weakest.get(quantity))
            ours = show.show(our_estimate).in_words
            if judge_number(number, our_estimate, exact.get(quantity)) == "cannot be":
                ours += f"; with exact impacts at least {show.show(exact[quantity]).in_words}, whoever drives"
                ours += f"; in the paper's map at least {map_rates}" if quantity == RATE else ""
            if row.agent in UNCONVERGED and verdict != "cannot be":
                verdict = "undecided"
            if (row.agent, quantity) == (E_V2X_BM, AVERAGE) and PREDICTED in stated:
                ours += f" (predicted: {show.show(mean(stated[PREDICTED][1])).in_words})"
            nearest_text = show.show(nearest_estimate).in_words + reported_as(row.agent, quantity)
            nearest_text += f", {judge_number(number, nearest_estimate)}"
            claims.append(Claim(f"{row.agent}, {quantity}", ours, nearest_text, verdict))
    return claims


def least_rates_in_map(episodes: int, least: Floats) -> dict[str, Estimate]:
    """Least collision rates in the paper's map: time step, in words -> rate.

    Each rate is that of exact impacts in all worlds (``least``: proven lower bound on the harm, [n] m2/s2), plus the
    difference between map and exact impacts in the first worlds: both bounds fail in nearly the same worlds.
    """
    certain, few = (least > 0.0).astype(np.float64), min(MAP_WORLDS, episodes)
    collides = {step_s: collides_in_map(STATED._replace(step_s=step_s), few) for step_s in MAP_STEPS_S}
    return {
        f"{step_s:g} s": unpaired_difference(mean(certain), mean(certain[:few] - rows))
        for step_s, rows in collides.items()
    }


def outcomes_sheet(title: str, outcomes: Mapping[str, RandomOutcome], least: Floats) -> Sheet:
    """``outcomes``: strategy -> outcome. ``least``: proven lower bound on the harm, [n] m2/s2."""
    rows = [
        (
            *(name, rate(outcome["collided"]), mean(outcome["first"]), mean(outcome["total"])),
            mean(outcome[PREDICTED]) if PREDICTED in outcome else None,
        )
        for name, outcome in outcomes.items()
    ]
    rows.append(("least possible (proven)", rate(least > 0.0), mean(least), mean(least), None))
    return Sheet(title, ("Strategy", *TABLE_COLUMNS), rows, "Harm in m²/s², with 95 % intervals.")


TABLE_COLUMNS = PERCENT, *map(Column, ("First-impact harm", "Total harm", "Predicted harm"))


def process_sheet(settings: ReproductionSettings) -> list[Sheet]:
    """Table of policies trained as in the paper, in its fixed-step map: means over seeds, with t intervals."""
    outcomes = process_outcomes(STATED, settings.episodes, settings)
    if not outcomes:
        return []
    mapped = strategies(STATED._replace(step_s=MAP_STEP_S), settings.episodes, {})
    keys = "collided", "first", "total", PREDICTED
    rows = [
        (name, *(outcome[key].mean() if key in outcome else None for key in keys)) for name, outcome in mapped.items()
    ]
    for policy, seeds in outcomes.items():
        for name in (policy, f"Hybrid {policy}"):
            values = {key: [seed[name][key].mean() for seed in seeds] for key in keys if key in seeds[0][name]}
            rows.append((name, *(mean(np.array(values[key])) if key in values else None for key in keys)))
    lengths = " ".join(f"{name}: {course.length}." for name, course in courses_of(settings, RANDOM).items())
    note = f"Time step {MAP_STEP_S:g} s. PPO and SAC: means over seeds with t intervals. Harm in m²/s². {lengths}"
    return [Sheet(f"The {PAPERS} in its map", ("Strategy", *TABLE_COLUMNS), rows, note)]


def harm_difference(outcomes: Mapping[str, RandomOutcome], smaller: str, *larger: str) -> list[Less]:
    return [
        Less.of_worlds(f"{smaller} minus {rival}, {harm}", outcomes[smaller][count], outcomes[rival][count])
        for rival in larger
        for count, harm in HARMS.items()
    ]


def compare_collisions(outcomes: Mapping[str, RandomOutcome], smaller: str, *larger: str) -> list[Less]:
    percent = {name: 100.0 * outcome["collided"] for name, outcome in outcomes.items()}
    return [
        Less.of_worlds(f"{smaller} minus {rival}, % of worlds", percent[smaller], percent[rival]) for rival in larger
    ]


def compare_over_seeds(seeds: Sequence[Mapping[str, RandomOutcome]], smaller: str, larger: str) -> list[Less]:
    """Comparisons of harm and collision rate between two strategies, over seeds of a policy trained as in the paper.

    ``seeds``: for each seed, strategy -> outcome.
    """
    return [
        Less(
            f"{smaller} minus {larger}, {harm}",
            mean(np.array([scale * (seed[smaller][count].mean() - seed[larger][count].mean()) for seed in seeds])),
        )
        for count, (harm, scale) in SCALES.items()
    ]


def conclusions(outcomes: Mapping[str, RandomOutcome]) -> dict[str, list[Less]]:
    """The paper's conclusions from its table: name -> comparisons that must all hold."""
    hybrids = [f"Hybrid {name}" for name in SHIPPED_SPECS]
    baselines = [name for name in (E_V2X_BM, COUPLED) if name in outcomes]
    return {
        "E-V2X-BM collides less": compare_collisions(outcomes, E_V2X_BM, NON_E),
        "Non-E collides most": [
            part for name in (E_V2X_BM, *hybrids) for part in compare_collisions(outcomes, name, NON_E)
        ],
        "hybrids collide least": [
            part for name in hybrids for part in compare_collisions(outcomes, name, NON_E, E_V2X_BM)
        ],
        "Non-E harms most": [part for name in (E_V2X_BM, *hybrids) for part in harm_difference(outcomes, name, NON_E)],
        "E-V2X-BM harms less": harm_difference(outcomes, E_V2X_BM, NON_E),
        "hybrids harm least": [part for name in hybrids for part in harm_difference(outcomes, name, NON_E, E_V2X_BM)],
        "learning harms less": [part for name in SHIPPED_SPECS for part in harm_difference(outcomes, name, *baselines)],
        "hybrid and baseline": [
            part
            for name in hybrids
            for part in (*harm_difference(outcomes, name, E_V2X_BM), *compare_collisions(outcomes, name, E_V2X_BM))
        ],
        "hybrid and learning": [
            part
            for name in SHIPPED_SPECS
            for part in (
                *harm_difference(outcomes, f"Hybrid {name}", name),
                *compare_collisions(outcomes, f"Hybrid {name}", name),
            )
        ],
    }


def avoidance_claim(policy: str, stated: Mapping[str, RandomOutcome], nearest: Mapping[str, RandomOutcome]) -> Claim:
    parts = [compare_collisions(outcomes, policy, E_V2X_BM) for outcomes in (stated, nearest)]
    text = avoided_text(stated[policy]["collided"], stated[E_V2X_BM]["collided"])
    return judge(f"{policy} avoids collisions", *parts, numbers=text)


def world_claims(outcomes: Mapping[str, RandomOutcome], least: Floats) -> list[Claim]:
    """Verdicts on what the paper says of single worlds, with the parameters as stated."""
    baseline, certain = outcomes[E_V2X_BM], least > 0.0
    severity = [
        Less.of_worlds(f"{name} minus {E_V2X_BM}", outcomes[name]["first"][certain], baseline["first"][certain])
        for name in SHIPPED_SPECS
    ]
    spared = np.any([~outcome["collided"] for outcome in outcomes.values()], axis=0)
    hybrids = [f"Hybrid {name}" for name in SHIPPED_SPECS]
    exceeded = {name: above_bound(outcomes[name]) for name in hybrids}
    worse = {name: count_worse(outcomes[name], baseline) for name in (*hybrids, *SHIPPED_SPECS)}
    some = baseline[PREDICTED] > 0.0
    same = np.isclose(baseline["first"], baseline[PREDICTED], rtol=1e-6)
    avoidable = {f"{name}'s avoidable collisions": outcomes[name]["collided"] & spared for name in (NON_E, E_V2X_BM)}
    return [
        judge("severity of certain collisions", severity),
        judge("three vehicles", harm_difference(outcomes, COUPLED, E_V2X_BM)),
        judge_share("expected is overall", same[some], "worlds with H* > 0"),
        bound_claim("safety bound", "H*", exceeded, len(least)),
        bound_claim("never worse", "E-V2X-BM's harm", worse, len(least)),
        *(
            Claim(
                name, f"in {PERCENT.show(rate(rows)).in_words} of all worlds", "", "agrees" if any(rows) else "differs"
            )
            for name, rows in avoidable.items()
        ),
    ]


def bound_claim(name: str, bound: str, above: Mapping[str, int], worlds: int) -> Claim:
    """The harm of no hybrid is above a bound in any world.

    ``above``: strategy -> number of worlds in which its harm is above it.
    """
    counts = ", ".join(f"{count:,} ({strategy})" for strategy, count in above.items())
    differs = any(count for strategy, count in above.items() if strategy.startswith("Hybrid"))
    return Claim(name, f"above {bound} in {counts} of {worlds:,} worlds", "", "differs" if differs else "agrees")


def count_worse(outcome: RandomOutcome, baseline: RandomOutcome) -> int:
    """First-impact or total harm."""
    return int(np.count_nonzero(np.any([outcome[harm] > baseline[harm] + ROUNDING for harm in HARMS], axis=0)))


def deceleration_claims(episodes: int) -> list[Claim]:
    """Verdicts on what the paper says of a*, the deceleration that E-V2X-BM chooses, with the parameters as stated."""
    plans = [STATED._replace(star=star).only(*PLANS) for star in get_args(Star)]
    none = plan(plans[0], episodes).harm == 0.0
    collided = [brake(STATED.only(*WORLD_FIELDS), choice, "brakes on", episodes)["collided"] for choice in plans]
    low, high = (plan(plans[k], episodes).deceleration_mps2 for k in (0, -1))
    return [
        judge_share("interval", ~np.any(collided, axis=0)[none], "worlds with H* = 0"),
        judge_share("unique", (high - low <= ROUNDING)[~none], "worlds with H* > 0"),
    ]


def gradient_claim(outcomes: Mapping[str, RandomOutcome], episodes: int) -> Claim:
    """Result of the shipped policy that follows gradients from simulated branches, beside those that use none.

    The verdict is always "undecided", because "challenging" is no number.
    """
    harms = {
        f"{GRADIENT} (by gradients)": drive_all(STATED.only(*WORLD_FIELDS), GRADIENT, "honest", episodes),
        **{name: outcomes[name] for name in (COUPLED, NON_E)},
    }
    text = ", ".join(f"{name} {outcome['total'].mean():.2f}" for name, outcome in harms.items())
    return Claim("gradients", f"total harm: {text}", "", "undecided")


def contribution_claims(settings: ReproductionSettings, episodes: int) -> list[Claim]:
    outcomes, courses = process_outcomes(STATED, episodes, settings), courses_of(settings, RANDOM)
    return [
        judge_trained(f"{name} by the process", {policy: courses[policy]}, compare_over_seeds(seeds, name, rival))
        for policy, seeds in outcomes.items()
        for name, rival in ((policy, E_V2X_BM), (f"Hybrid {policy}", policy))
    ]


def reproduce_random_table(settings: ReproductionSettings) -> Made:
    """Table III (``Table:Random``)."""
    episodes = settings.episodes
    least = proven_least_harm(STATED, episodes)
    in_map = least_rates_in_map(episodes, least)
    rows = {E_V2X_BM: "", NON_E: "", **{f"Hybrid {name}": spec for name, spec in SHIPPED_SPECS.items()}}
    stated, nearest = (
        {row: report_outcome(row, reading, episodes, spec) for row, spec in rows.items()}
        for reading in (STATED, NEAREST)
    )
    stated[PREDICTED] = report_outcome(E_V2X_BM, STATED._replace(baseline="predicted"), episodes)
    claims = number_claims(RANDOM_TEST, stated, nearest, least, in_map)
    outcomes, nearest_outcomes = (strategies(reading, episodes, SHIPPED_SPECS) for reading in (STATED, NEAREST))
    parts, nearest_parts = (conclusions(reading) for reading in (outcomes, nearest_outcomes))
    claims += [judge(name, parts[name], nearest_parts[name]) for name in parts]
    claims += [avoidance_claim(name, outcomes, nearest_outcomes) for name in SHIPPED_SPECS]
    claims += [*world_claims(outcomes, least), *deceleration_claims(episodes)]
    claims += [gradient_claim(outcomes, episodes), *contribution_claims(settings, episodes)]
    note = f"Exact impacts, plus the difference of the map in the first {min(MAP_WORLDS, episodes)} worlds."
    bounds = Sheet("Least collision rate in the paper's map", ("Time step", PERCENT), [*in_map.items()], note)
    sheets = [outcomes_sheet("The random test, as stated", outcomes, least), bounds, *process_sheet(settings)]
    return Made(claims, sheets, notes=[DRIVERS])


def reproduce_hybrid_table(settings: ReproductionSettings) -> Made:
    """Table II (``Table:hybrid``), with our policy that has not converged."""
    episodes, spec = min(STOPPED_WORLDS, settings.episodes), unconverged_policy(settings.folder)
    least = proven_least_harm(STATED, episodes)

    def rows(reading: Reading) -> ReportedRows:
        alone = report_outcome("Hybrid PPO", reading._replace(hybrid="policy alone"), episodes, spec)
        hybrid = report_outcome("Hybrid PPO", reading, episodes, spec)
        predicted = report_outcome(E_V2X_BM, reading._replace(baseline="predicted"), episodes)
        policy_rows = {STANDALONE: alone, "Hybrid": hybrid, PREDICTED: predicted}
        return {row: report_outcome(row, reading, episodes) for row in (NON_E, E_V2X_BM)} | policy_rows

    claims = number_claims(HYBRID_TEST, rows(STATED), rows(NEAREST), least, least_rates_in_map(episodes, least))
    first, second, avoided = (row.episodes - row.collisions for row in HYBRID_TEST)
    verdict: Verdict = "cannot be" if avoided > first + second else "agrees"
    claims.append(Claim("avoided", f"at most {first:,} + {second:,} = {first + second:,}", "", verdict))
    outcomes, nearest_outcomes = (strategies(reading, episodes, {"DRL": spec}) for reading in (STATED, NEAREST))
    name, rivals = "Hybrid DRL", ("DRL", E_V2X_BM)
    parts = [
        harm_difference(reading_outcomes, name, *rivals) + compare_collisions(reading_outcomes, name, *rivals)
        for reading_outcomes in (outcomes, nearest_outcomes)
    ]
    claims.append(judge("outperforms", *parts)._replace(verdict="undecided"))  # where our policy stops is our choice
    note = "The paper does not describe its policy that has not converged; ours has had a fifteenth of its decisions."
    return Made(claims, [outcomes_sheet("The 5,000 worlds, as stated", outcomes, least)], notes=[note])
