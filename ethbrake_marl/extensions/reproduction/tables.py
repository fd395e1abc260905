"""Compare the paper's tables (``Table:hybrid``, ``Table:Random``) and its two contributions with our results."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from operator import itemgetter

import numpy as np

from ethbrake_marl.agents.pairwise import (
    CLOSED_FORM_CANDIDATES,
    RELATIVE_TIE,
    find_candidates,
    harm_of_deceleration,
    pairwise,
)
from ethbrake_marl.evaluation.statistics import mean, rate, unpaired_difference
from ethbrake_marl.extensions.reproduction.made import DRIVERS, Made, ReproductionSettings
from ethbrake_marl.extensions.reproduction.map_bound import collides_in_map
from ethbrake_marl.extensions.reproduction.paper_rows import HYBRID_TEST, RANDOM_TEST, PaperRow
from ethbrake_marl.extensions.reproduction.readings import OURS, STATED
from ethbrake_marl.extensions.reproduction.strategies import (
    COUPLED,
    E_V2X_BM,
    HARMS,
    NON_E,
    PREDICTED,
    SHIPPED_SPECS,
    VEHICLE_2,
    Outcomes,
    avoided_text,
    contact_unavoidable,
    drive,
    impact_unavoidable,
    open_reading,
    proven_least_harm,
    strategies,
    times_above,
)
from ethbrake_marl.extensions.reproduction.verdicts import (
    HARM,
    PERCENT,
    Claim,
    Less,
    Result,
    Verdict,
    judge,
    judge_in_each,
    judge_number,
    judge_share,
    same_claim,
)
from ethbrake_marl.files.sheet import Column, Estimate, Sheet
from ethbrake_marl.motion.layout import BRAKING, LATENCY, Bools, Floats

STOPPED_WORLDS = 5_000  # of ``Table:hybrid``
GRADIENT = "vine-paper"  # shipped policy, trained by the algorithm ``vine``
HYBRIDS = tuple(f"Hybrid {name}" for name in SHIPPED_SPECS)
EXACT = "exact impacts"
MAP_WORLDS, MAP_STEPS_S = 1_000, (0.1, 0.2, 0.25, 0.3)  # of the bound in the paper's map


def number_claims(row: PaperRow, outcomes: Mapping[str, Outcomes], bounds: Mapping[str, Estimate]) -> list[Claim]:
    """Verdict on the collision rate and the mean harm that the paper prints for a strategy.

    ``outcomes``: reading -> strategy -> outcome. ``bounds``: ``least_rates``.
    """
    rates, harms = {}, {}
    bound = f"; {at_least(bounds)}"
    for reading, driven in outcomes.items():
        collided, harm = rate(driven[row.agent]["collided"]), mean(driven[row.agent]["first"])
        verdict, text = judge_number(row.collision_rate, collided), PERCENT.show(collided).in_words
        rates[reading] = Result(text, verdict)
        if is_excluded(row.collision_rate, bounds):
            rates[reading] = Result(text + bound, "cannot be")
        harms[reading] = Result(HARM.show(harm).in_words, judge_number(row.average_harm, harm))
    return [Claim(f"{row.agent}, collision rate", rates), Claim(f"{row.agent}, average harm", harms)]


def at_least(bounds: Mapping[str, Estimate]) -> str:
    return f"at least {PERCENT.show(bounds[EXACT]).in_words} with an impact, whoever drives"


def is_excluded(printed: float, bounds: Mapping[str, Estimate]) -> bool:
    """Whether a collision rate cannot be for exact impacts, and not in the map with any of its steps."""
    return all(judge_number(printed, bound, bound) == "cannot be" for bound in bounds.values())


def least_rates(episodes: int) -> dict[str, Estimate]:
    """Least collision rates: physics in words -> rate, for exact impacts and for steps of the paper's map.

    In the map a contact at a sample is a collision, as in the paper. Its rate is that of contact in all worlds, plus
    the difference between map and contact in the first worlds: both happen in nearly the same worlds.
    """
    contact, few = contact_unavoidable(STATED, episodes).astype(np.float64), min(MAP_WORLDS, episodes)
    rates = {EXACT: rate(impact_unavoidable(STATED, episodes))}
    for step_s in MAP_STEPS_S:
        in_map = collides_in_map(STATED._replace(step_s=step_s), few)
        rates[f"map, steps of {step_s:g} s"] = unpaired_difference(mean(contact), mean(contact[:few] - in_map))
    return rates


def rates_sheet(rates: Mapping[str, Estimate]) -> Sheet:
    note = (
        "Exact impacts: worlds in which an impact is proven. Map: contact at a sample; that of exact motion, plus its"
        f" difference in the first {MAP_WORLDS:,} worlds."
    )
    return Sheet("Least collision rate of every strategy", ("Impacts", PERCENT), [*rates.items()], note)


def outcomes_sheet(title: str, outcomes: Outcomes) -> Sheet:
    rows = [
        (name, rate(outcome["collided"]), *(mean(outcome[key]) if key in outcome else None for key in TABLE_KEYS))
        for name, outcome in outcomes.items()
    ]
    return Sheet(title, ("Strategy", *TABLE_COLUMNS), rows, "Harm in m²/s², with 95 % intervals.")


TABLE_KEYS = "first", "total", PREDICTED
TABLE_COLUMNS = PERCENT, *map(Column, ("Harm", "Total harm", "Predicted harm"))


def harm_difference(outcomes: Outcomes, smaller: str, *larger: str) -> list[Less]:
    return [
        Less.of_worlds(f"{smaller} minus {rival}, {harm}", outcomes[smaller][count], outcomes[rival][count])
        for rival in larger
        for count, harm in HARMS.items()
        if count in outcomes[smaller]
    ]


def compare_collisions(outcomes: Outcomes, smaller: str, *larger: str) -> list[Less]:
    percent = {name: 100.0 * outcome["collided"] for name, outcome in outcomes.items()}
    return [
        Less.of_worlds(f"{smaller} minus {rival}, % of worlds", percent[smaller], percent[rival]) for rival in larger
    ]


def conclusions(outcomes: Outcomes) -> dict[str, list[Less]]:
    """The paper's conclusions from its table: name -> comparisons that must all hold."""
    baselines = [name for name in (E_V2X_BM, COUPLED) if name in outcomes]
    return {
        "E-V2X-BM collides less": compare_collisions(outcomes, E_V2X_BM, NON_E),
        "Non-E collides most": [
            part for name in (E_V2X_BM, *HYBRIDS) for part in compare_collisions(outcomes, name, NON_E)
        ],
        "hybrids collide least": [
            part for name in HYBRIDS for part in compare_collisions(outcomes, name, NON_E, E_V2X_BM)
        ],
        "Non-E harms most": [part for name in (E_V2X_BM, *HYBRIDS) for part in harm_difference(outcomes, name, NON_E)],
        "E-V2X-BM harms less": harm_difference(outcomes, E_V2X_BM, NON_E),
        "hybrids harm least": [part for name in HYBRIDS for part in harm_difference(outcomes, name, NON_E, E_V2X_BM)],
        "learning harms less": [part for name in SHIPPED_SPECS for part in harm_difference(outcomes, name, *baselines)],
        "hybrid and baseline": [
            part
            for name in HYBRIDS
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
        "three vehicles": [
            *harm_difference(outcomes, E_V2X_BM, NON_E),
            *(harm_difference(outcomes, COUPLED, E_V2X_BM) if COUPLED in outcomes else ()),
        ],
    }


def severity(outcomes: Outcomes, certain: Bools) -> list[Less]:
    """Policies do less harm than E-V2X-BM where an impact is ``certain``, [n]."""
    return [
        Less.of_worlds(
            f"{name} minus {E_V2X_BM}", outcomes[name]["first"][certain], outcomes[E_V2X_BM]["first"][certain]
        )
        for name in SHIPPED_SPECS
    ]


def bounded(bound: str, above: Mapping[str, int], worlds: int) -> Result:
    """The harm of no hybrid is above a bound in any world.

    ``above``: strategy -> number of worlds in which its harm is above it.
    """
    counts = ", ".join(f"{count:,} ({strategy})" for strategy, count in above.items())
    differs = any(count for strategy, count in above.items() if strategy in HYBRIDS)
    return Result(f"above {bound} in {counts} of {worlds:,} worlds", "differs" if differs else "agrees")


def world_claims(of_reading: Mapping[str, Outcomes]) -> list[Claim]:
    """Verdicts on what the paper says of the harm in single worlds."""
    overall, safe, better = {}, {}, {}
    for reading, outcomes in of_reading.items():
        baseline = outcomes[E_V2X_BM]
        bound, worlds = baseline[PREDICTED], len(baseline["first"])
        same = np.isclose(baseline["first"], bound, rtol=1e-6)
        overall[reading] = judge_share(same[bound > 0.0], "worlds with H* > 0")
        exceeded = {name: times_above(outcomes[name]["first"], bound) for name in HYBRIDS}
        safe[reading] = bounded("H*", exceeded, worlds)
        worse = {name: times_above(outcomes[name]["first"], baseline["first"]) for name in (*HYBRIDS, *SHIPPED_SPECS)}
        better[reading] = bounded("E-V2X-BM's harm", worse, worlds)
    return [Claim("expected is overall", overall), Claim("safety bound", safe), Claim("never worse", better)]


def avoidance_claims(outcomes: Outcomes, contact: Bools, impact: Bools) -> list[Claim]:
    """Who collides where ``contact`` is not certain, and at most where an ``impact`` is not, [n]; the same in every
    reading.
    """
    claims = []
    for name in (NON_E, E_V2X_BM):
        collided = outcomes[name]["collided"]
        needless, most = collided & ~contact, collided & ~impact
        share = PERCENT.show(rate(needless)).in_words
        of_all = f"{needless.sum():,} to {most.sum():,} of its {collided.sum():,} collisions"
        text = f"at least in {share} of all worlds ({of_all})"
        verdict: Verdict = "agrees" if needless.any() else "differs"
        claims.append(same_claim(f"{name}'s avoidable collisions", text, verdict, PERCENT.show(needless.mean()).value))
    for name in SHIPPED_SPECS:
        policy, baseline = outcomes[name]["collided"], outcomes[E_V2X_BM]["collided"]
        result = judge(compare_collisions(outcomes, name, E_V2X_BM), avoided_text(policy, baseline))
        share = PERCENT.show((baseline & ~policy).mean()).value
        claims.append(Claim(f"{name} avoids collisions", {OURS: result}, share))
    return claims


def ends_of_star(episodes: int) -> tuple[Floats, Floats]:
    """The smallest and the largest deceleration of Vehicle 2 with the least predicted harm, [n] m/s2 each."""
    alert, at = open_reading(STATED, episodes)[2], np.empty(CLOSED_FORM_CANDIDATES)
    ends = np.empty((2, episodes))
    for k, (line, car) in enumerate(zip(alert.line, alert.car.copy(), strict=True)):
        world = line, car[BRAKING], car[LATENCY], VEHICLE_2
        find_candidates(*world, at)  # type: ignore[no-untyped-call]
        possible = at[(at >= 0.0) & (at <= car[BRAKING, VEHICLE_2])]
        harm = np.array([harm_of_deceleration(*world, a) for a in possible])  # type: ignore[no-untyped-call]
        tied = possible[harm <= harm.min() + RELATIVE_TIE * (1.0 + harm.min())]
        ends[:, k] = tied.min(), tied.max()
    return ends[0], ends[1]


def deceleration_claims(episodes: int) -> list[Claim]:
    """Verdicts on what the paper says of a*, the deceleration that E-V2X-BM chooses. The same in every reading."""
    _, game, alert = open_reading(STATED, episodes)
    free = pairwise(alert, VEHICLE_2).harm == 0.0
    low, high = ends_of_star(episodes)
    collided = np.zeros(episodes, np.bool_)
    for deceleration in (low, 0.5 * (low + high), high):
        car = alert.car.copy()
        car[:, BRAKING, VEHICLE_2] = deceleration
        state = game.reset(alert._replace(car=car))
        while not state.ended.all():
            state, _ = game.step(state, np.full((episodes, 1), -1.0))
        collided |= state.collided
    interval = judge_share(~collided[free], "worlds with H* = 0")
    unique = judge_share((high - low <= ONE_MPS2)[~free], "worlds with H* > 0")
    return [Claim("interval", {OURS: interval}), Claim("unique", {OURS: unique})]


ONE_MPS2 = 1e-9  # decelerations closer than this are one


def gradient_claim(outcomes: Outcomes, episodes: int) -> Claim:
    """Result of the shipped policy that follows gradients from simulated branches, beside those that use none.

    The verdict is always "undecided", because "challenging" is no number.
    """
    harms = {f"{GRADIENT} (by gradients)": drive(STATED, GRADIENT, episodes)}
    harms |= {name: outcomes[name] for name in (COUPLED, NON_E)}
    text = ", ".join(f"{name} {outcome['total'].mean():.2f}" for name, outcome in harms.items())
    return same_claim("gradients", f"total harm: {text}", "undecided")


def reproduce_random_table(settings: ReproductionSettings) -> Made:
    """Table III (``Table:Random``)."""
    episodes = settings.episodes
    outcomes = strategies(STATED, episodes, SHIPPED_SPECS)
    contact, impact = (prove(STATED, episodes) for prove in (contact_unavoidable, impact_unavoidable))
    rates = least_rates(episodes)
    claims = [claim for row in RANDOM_TEST for claim in number_claims(row, outcomes, rates)]
    concluded = {reading: conclusions(driven) for reading, driven in outcomes.items()}
    claims += [judge_in_each(name, concluded, itemgetter(name)) for name in concluded[OURS]]
    claims += [judge_in_each("severity of certain collisions", outcomes, lambda driven: severity(driven, impact))]
    claims += [*world_claims(outcomes), *avoidance_claims(outcomes[OURS], contact, impact)]
    claims += deceleration_claims(episodes)
    claims += [gradient_claim(outcomes[OURS], episodes)]
    sheets = [outcomes_sheet(f"The random test, {reading}", driven) for reading, driven in outcomes.items()]
    least = mean(proven_least_harm(STATED, episodes))
    lowest = "least possible (proven)", rate(impact), least, least, None
    sheets[0] = replace(sheets[0], rows=[*sheets[0].rows, lowest])
    return Made(claims, [*sheets, rates_sheet(rates)], notes=[DRIVERS])


def reproduce_hybrid_table(settings: ReproductionSettings) -> Made:
    """Table II (``Table:hybrid``). Its policy that has not converged is recorded."""
    episodes = min(STOPPED_WORLDS, settings.episodes)
    outcomes = strategies(STATED, episodes, {})
    bounds = least_rates(episodes)
    printed = {row.agent: row for row in HYBRID_TEST}
    claims = number_claims(printed[E_V2X_BM], outcomes, bounds)
    first, second, avoided = (row.episodes - row.collisions for row in HYBRID_TEST)
    text = f"{avoided:,} of at most {first:,} + {second:,} = {first + second:,}"
    claims.append(same_claim("avoided", text, "cannot be" if avoided > first + second else "agrees"))
    excluded = is_excluded(printed["Hybrid"].collision_rate, bounds)
    claims.append(same_claim("Hybrid, collision rate", at_least(bounds), "cannot be" if excluded else "undecided"))
    return Made(claims, notes=["The policy that has not converged is ours: a fifteenth of the decisions of `ppo`."])
