"""Harm against distance and delay: the figures ``Fig:Harm-ivds``, ``Fig:harm-delay`` and ``Fig:hybrid illu``.

A *reading* is one interpretation of the paper's text (``readings``).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise

import numpy as np

from ethbrake_marl.episode.counts import FIRST_IMPACTS
from ethbrake_marl.evaluation.statistics import mean
from ethbrake_marl.extensions.report.figures import curves_figure
from ethbrake_marl.extensions.report.style import axis_title
from ethbrake_marl.extensions.reproduction.learning import RANDOM, courses_of, judge_trained, unconverged_policy
from ethbrake_marl.extensions.reproduction.made import DRIVERS, DrawnFigure, Made, ReproductionSettings
from ethbrake_marl.extensions.reproduction.random_test import (
    E_V2X_BM,
    NON_E,
    ROUNDING,
    SHIPPED_SPECS,
    WORLD_FIELDS,
    avoided_text,
    brake,
    open_reading,
)
from ethbrake_marl.extensions.reproduction.readings import NEAREST, STATED, Reading
from ethbrake_marl.extensions.reproduction.strategies import (
    COUPLED,
    MAP_STEP_S,
    PAPERS,
    PREDICTED,
    SIMULATED,
    process_outcomes,
    proven_least_harm,
    strategies,
)
from ethbrake_marl.extensions.reproduction.verdicts import Claim, Less, Verdict, judge
from ethbrake_marl.files.sheet import Column, Estimate, Sheet
from ethbrake_marl.motion.layout import Floats

Lines = Mapping[str, Floats]  # strategy -> first-impact harm of each world, [n], or of each seed and world, [seeds, n]
Groups = Mapping[str, tuple[Lines, Floats]]  # group of worlds, or delay -> lines, and the places of its worlds

DISTANCE, DISTANCE_WORLDS, ROOM_WORLDS = "paper-distance", 5_000, 1_000
ACTS_S = (0.1, 0.3, 0.5, 0.7)  # latencies of Vehicle 2, below that of Vehicle 3
ENDS_M = (10, 12, 14, 16, 18, 20)  # of the groups, for the sum of both gaps

EXPECTED, PROVEN, ALONE = "E-V2X-BM, predicted", "least harm, proven", "PPO, not converged"


def harm_of_strategies(reading: Reading, episodes: int, policies: Mapping[str, str]) -> dict[str, Floats]:
    """First-impact harm, name -> [n] m2/s2.

    ``policies``: name -> agent name. Also contains the harm that E-V2X-BM predicts and, for exact impacts, the proven
    lower bound.
    """
    outcomes = strategies(reading, episodes, policies)
    lines = {name: outcome["first"] for name, outcome in outcomes.items()} | {EXPECTED: outcomes[E_V2X_BM][PREDICTED]}
    return lines | ({PROVEN: proven_least_harm(reading, episodes)} if reading.step_s is None else {})


def process_lines(reading: Reading, episodes: int, settings: ReproductionSettings) -> dict[str, Floats]:
    """[seeds, n] for a trained policy and [n] for other strategies, in m2/s2. Empty if there are no such trainings."""
    outcomes = process_outcomes(reading, episodes, settings)
    trained = {name: np.stack([seed[name]["first"] for seed in seeds]) for name, seeds in outcomes.items()}
    return {**harm_of_strategies(reading._replace(step_s=MAP_STEP_S), episodes, {}), **trained} if outcomes else {}


def mean_harm(line: Floats, rows: Floats) -> Estimate:
    """``rows``: mask [n]. If ``line`` is [n], the interval is over worlds; if it is [training seeds, n], over the
    seeds.
    """
    return mean(line[rows]) if line.ndim == 1 else mean(line[:, rows].mean(axis=1))


def by_distance(reading: Reading, episodes: int, lines: Lines) -> Groups:
    group = np.digitize(open_reading(reading.only(*WORLD_FIELDS), episodes)[2].gaps_m.sum(axis=1), ENDS_M[1:-1])
    return {f"{ENDS_M[k]}-{ENDS_M[k + 1]} m": (lines, group == k) for k in np.unique(group).tolist()}


def less_in_each(groups: Groups, smaller: str, larger: str) -> list[Less]:
    return [
        Less.of_worlds(f"{smaller} minus {larger}, {group}", lines[smaller][rows], lines[larger][rows])
        for group, (lines, rows) in groups.items()
    ]


def show_harm(stem: str, title: str, readings: Mapping[str, Groups], legend: Sequence[str], x_label: str) -> Made:
    """``readings``: name -> group of worlds -> harm of each strategy, and mask of the group's worlds. ``legend``:
    strategies in the figure.
    """
    estimates = {
        reading: {
            name: {group: mean_harm(lines[name], rows) for group, (lines, rows) in groups.items()} for name in names
        }
        for reading, groups in readings.items()
        for names in ([*next(iter(groups.values()))[0]],)
    }
    panels = {
        reading: {name: curve for name, curve in curves.items() if name in legend}
        for reading, curves in estimates.items()
    }
    text = "Mean first-impact harm of each strategy under each reading; bands: 95 % intervals."
    figure = curves_figure(panels, x_label, f"{title}. {text}", y_label=axis_title(FIRST_IMPACTS))
    sheets = [
        Sheet(
            f"{title}, {reading}",
            ("Strategy", *map(Column, readings[reading])),
            [(name, *curve.values()) for name, curve in curves.items()],
            "First-impact harm, m²/s², with 95 % intervals.",
        )
        for reading, curves in estimates.items()
    ]
    return Made((), sheets, [DrawnFigure(stem, title, text, figure)])


def over_distance(stem: str, readings: Mapping[str, Groups], legend: Sequence[str]) -> Made:
    return show_harm(stem, "Harm by total distance", readings, legend, "Total distance d1 + d2 at the alert")


def distances(settings: ReproductionSettings, policies: Mapping[str, str]) -> dict[str, Groups]:
    episodes = min(DISTANCE_WORLDS, settings.episodes)
    readings = {
        name: reading._replace(base=DISTANCE) for name, reading in (("as stated", STATED), ("nearest reading", NEAREST))
    }
    return {
        name: by_distance(reading, episodes, harm_of_strategies(reading, episodes, policies))
        for name, reading in readings.items()
    }


def reproduce_distance(settings: ReproductionSettings) -> Made:
    """Fig. 4."""
    readings = distances(settings, SHIPPED_SPECS)
    groups = readings["as stated"]
    stated, nearest = (statements(lines) | statements(lines, EXPECTED) for lines in readings.values())
    claims = [judge(name, parts, nearest[name]) for name, parts in stated.items()]
    claims += [judge("Non-E grows", *(growth_between_groups(lines, NON_E) for lines in readings.values()))]
    distance_reading, episodes = STATED._replace(base=DISTANCE), min(DISTANCE_WORLDS, settings.episodes)
    claims += [constant_claim(groups), advantage_claim(groups), capacity_claim(distance_reading, episodes)]
    claims += [avoidance_by_distance(groups, policy) for policy in SHIPPED_SPECS]
    if lines := process_lines(distance_reading, episodes, settings):
        readings[PAPERS] = by_distance(distance_reading, episodes, lines)
        claims += process_claims(settings, readings[PAPERS], [E_V2X_BM])
    result = over_distance("harm-distance", readings, [NON_E, E_V2X_BM, COUPLED, *SHIPPED_SPECS, EXPECTED, PROVEN])
    return result._replace(claims=claims, notes=[DRIVERS])


def statements(groups: Groups, baseline: str = E_V2X_BM) -> dict[str, list[Less]]:
    """``baseline``: harm of E-V2X-BM, done or predicted."""
    shortest, *_, longest = (lines[baseline][rows] for lines, rows in groups.values())
    return {
        f"{NON_E} harms most, {baseline}": [
            part for name in (baseline, *SHIPPED_SPECS) for part in less_in_each(groups, name, NON_E)
        ],
        f"less than {NON_E}, {baseline}": less_in_each(groups, baseline, NON_E),
        f"shortest distance, {baseline}": [
            Less.of_lists(f"{baseline}, longest minus shortest distance", longest, shortest)
        ],
        f"learning harms less, {baseline}": [
            part for policy in SHIPPED_SPECS for part in less_in_each(groups, policy, baseline)
        ],
    }


def constant_claim(groups: Groups) -> Claim:
    """At the shortest distance even the best constant deceleration does more harm than learned braking."""
    (distance, (lines, rows)), *_ = groups.items()
    harm = {name: lines[name][rows] for name in (E_V2X_BM, COUPLED, *SHIPPED_SPECS, PROVEN)}
    parts = [Less.of_worlds(f"{name} minus {COUPLED}", harm[name], harm[COUPLED]) for name in SHIPPED_SPECS]
    text = ", ".join(f"{name} {values.mean():.2f}" for name, values in harm.items())
    causes = {"the wrong prediction": (E_V2X_BM, COUPLED), "a constant deceleration": (COUPLED, PROVEN)}
    costs = (f"{cause} costs {harm[more].mean() - harm[less].mean():.1f}" for cause, (more, less) in causes.items())
    return judge("constant deceleration", parts, numbers=f"{distance}: {text}; {', '.join(costs)}")


def advantage_claim(groups: Groups) -> Claim:
    """Policies gain more over E-V2X-BM at the shortest distance than at the longest."""
    gains = {
        policy: [lines[policy][rows] - lines[E_V2X_BM][rows] for lines, rows in groups.values()]
        for policy in SHIPPED_SPECS
    }
    parts = [
        Less.of_lists(f"{policy}, shortest minus longest distance", shortest, longest)
        for policy, (shortest, *_, longest) in gains.items()
    ]
    texts = (
        f"{policy} {', '.join(f'{gain.mean():+.2f}' for gain in all_gains)}" for policy, all_gains in gains.items()
    )
    return judge("advantage", parts, numbers=f"minus E-V2X-BM, by distance: {'; '.join(texts)}")


def capacity_claim(reading: Reading, episodes: int) -> Claim:
    """Verdict on why the harm of Non-E grows with the distance: Vehicle 2 can brake harder than Vehicle 3.

    Then the harm must fall with the distance if Vehicle 3 is the one that can brake harder.
    """
    ends = {}  # braking capacity of Vehicle 3 (m/s2; that of Vehicle 2 is 7) -> harm at the shortest, longest distance
    for rear in (6.0, 7.0, 8.0):
        world = reading._replace(others=(("braking_capacity_mps2", (6.0, 7.0, rear)),))
        harm = brake(world.only(*WORLD_FIELDS), None, "brakes on", episodes)["first"]
        (_, shortest), *_, (_, longest) = by_distance(world, episodes, {}).values()
        ends[rear] = harm[shortest], harm[longest]
    parts = [Less.of_lists("a3 = 6", *ends[6.0]), Less.of_lists("a3 = 8", *reversed(ends[8.0]))]
    texts = (f"a3 = {rear:g}: {near.mean():.2f} to {far.mean():.2f}" for rear, (near, far) in ends.items())
    return judge("a2 above a3", parts, numbers=f"shortest to longest distance, {', '.join(texts)}")


def avoidance_by_distance(groups: Groups, policy: str) -> Claim:
    """At the distance at which a policy gains most, it avoids more collisions of E-V2X-BM than it adds."""
    collided = {
        distance: [lines[name][rows] > 0.0 for name in (policy, E_V2X_BM)] for distance, (lines, rows) in groups.items()
    }
    changed = {distance: pair for distance, pair in collided.items() if (pair[0] != pair[1]).any()}
    gains = (Less.of_worlds(distance, *(1.0 * rows for rows in pair)) for distance, pair in changed.items())
    most = sorted(gains, key=lambda gain: gain.difference.ends[1])[:1]
    text = "; ".join(f"{distance} {avoided_text(*pair)}" for distance, pair in collided.items())
    return judge(f"{policy} avoids collisions", most, numbers=text)


def process_claims(settings: ReproductionSettings, groups: Groups, rivals: Sequence[str]) -> list[Claim]:
    """Each algorithm does less harm than ``rivals`` in each group of worlds."""
    claims = []
    for policy, course in courses_of(settings, RANDOM).items():
        parts = [
            Less(
                f"{policy} minus {rival}, {group}",
                mean(lines[policy][:, rows].mean(axis=1) - lines[rival][rows].mean()),
                not (lines[policy][:, rows].any() or lines[rival][rows].any()),
            )
            for group, (lines, rows) in groups.items()
            for rival in rivals
        ]
        claims.append(judge_trained(f"{policy} by the process", {policy: course}, parts))
    return claims


def growth_between_groups(groups: Groups, name: str) -> list[Less]:
    harms = {group: lines[name][rows] for group, (lines, rows) in groups.items()}
    return [Less.of_lists(f"{lower} minus {higher}", harms[lower], harms[higher]) for lower, higher in pairwise(harms)]


DELAYS = ("low", "middle", "high")
PAPER_WORLD = (("gaps_m", (7.0, 7.0)), ("speeds_mps", (20.0, 18.0, 20.0)))  # the world of the paper's figure


def reproduce_delays(settings: ReproductionSettings) -> Made:
    """Fig. 5: at three delays, which are our choice, in the one world of the paper's figure."""
    groups, trained, only_world = {}, {}, np.array([True])
    for delay in DELAYS:
        reading = STATED._replace(base=f"paper-delay-{delay}", others=PAPER_WORLD)
        _, middle, rear = open_reading(reading.only(*WORLD_FIELDS), 1)[2].latency_s[0]
        name = f"{delay} ({middle:g}, {rear:g} s)"
        groups[name] = harm_of_strategies(reading, 1, SHIPPED_SPECS), only_world
        trained[name] = process_lines(reading, 1, settings), only_world
    parts = [
        part
        for policy in SHIPPED_SPECS
        for baseline in (NON_E, E_V2X_BM, COUPLED)
        for part in less_in_each(groups, policy, baseline)
    ]
    readings = {"as stated": groups} | ({PAPERS: trained} if all(lines for lines, _ in trained.values()) else {})
    claims = [judge("learning harms least", parts), robustness_claim(groups)]
    claims += [room_claim(settings), time_claim(settings)]
    if PAPERS in readings:
        claims += process_claims(settings, trained, [NON_E, E_V2X_BM])
    legend = [NON_E, E_V2X_BM, COUPLED, *SHIPPED_SPECS, EXPECTED, PROVEN]
    result = show_harm("harm-delays", "Gaps of 7 m, speeds of 20, 18 and 20 m/s", readings, legend, "Delay")
    return result._replace(claims=claims, notes=[f"One world: no intervals. {DRIVERS}"])


def robustness_claim(groups: Groups) -> Claim:
    """From the low to the high delay, the harm of a policy grows less than that of other strategies."""
    (low, _), *_, (high, _) = groups.values()
    growth = {name: high[name] - low[name] for name in (NON_E, E_V2X_BM, COUPLED, *SHIPPED_SPECS)}
    parts = [
        Less.of_worlds(f"{policy} minus {name}", growth[policy], growth[name])
        for policy in SHIPPED_SPECS
        for name in (NON_E, E_V2X_BM, COUPLED)
    ]
    return judge("robust", parts, numbers=", ".join(f"{name} {by.mean():+.2f}" for name, by in growth.items()))


def room_claim(settings: ReproductionSettings) -> Claim:
    """Always "undecided": at the high delay the room for learning is less as a share, and more in m2/s2."""
    episodes, shares = min(ROOM_WORLDS, settings.episodes), []
    for delay in ("low", "high"):
        reading = STATED._replace(base=f"paper-delay-{delay}")
        braking = brake(reading.only(*WORLD_FIELDS), None, "brakes on", episodes)["first"]
        shares.append(f"{delay} {proven_least_harm(reading, episodes).mean():.2f} of {braking.mean():.2f}")
    text = f"harm of Non-E that no strategy avoids, random test: {', '.join(shares)}"
    return Claim("room", text, "", "undecided")


def time_claim(settings: ReproductionSettings) -> Claim:
    """The later Vehicle 2 acts, the more harm is certain, if Vehicle 3 always brakes at the same time."""
    episodes = min(ROOM_WORLDS, settings.episodes)
    least = {f"{acts_s:g} s": proven_least_harm(STATED._replace(acts_s=acts_s), episodes) for acts_s in ACTS_S}
    parts = [Less.of_worlds(f"{early} minus {late}", least[early], least[late]) for early, late in pairwise(least)]
    text = ", ".join(f"{harm.mean():.2f} at {acts}" for acts, harm in least.items())
    return judge("time", parts, numbers=f"least harm, proven, by the latency of Vehicle 2 alone: {text}")


def reproduce_illustration(settings: ReproductionSettings) -> Made:
    """Fig. 8. The verdict says in how many worlds the hybrid does not pick the strategy of lower harm."""
    readings = distances(settings, {ALONE: unconverged_policy(settings.folder)})
    hybrid = f"Hybrid {ALONE}"
    stated, nearest = (next(iter(groups.values()))[0] for groups in readings.values())
    counts = [
        np.count_nonzero(lines[hybrid] > np.minimum(lines[ALONE], lines[E_V2X_BM]) + ROUNDING)
        for lines in (stated, nearest)
    ]
    ours, in_nearest = (f"not in {count:,} of {len(stated[hybrid]):,} worlds" for count in counts)
    share = stated[EXPECTED].mean() / stated[E_V2X_BM].mean()
    verdict: Verdict = "differs" if counts[0] else "agrees"
    claim = Claim("lower", f"{ours}; predicted harm {100.0 * share:.0f} % of the realised", in_nearest, verdict)
    result = over_distance(
        "hybrid-illustration", readings, [E_V2X_BM, COUPLED, ALONE, hybrid, f"{hybrid}, {SIMULATED}"]
    )
    return result._replace(claims=[claim])
