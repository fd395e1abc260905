"""Harm against distance and delay: the figures ``Fig:Harm-ivds``, ``Fig:harm-delay`` and ``Fig:hybrid illu``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from itertools import pairwise

import numpy as np

from ethbrake_marl.episode.counts import FIRST_IMPACTS
from ethbrake_marl.evaluation.statistics import mean
from ethbrake_marl.extensions.report.figures import curves_figure
from ethbrake_marl.extensions.report.style import axis_title
from ethbrake_marl.extensions.reproduction.made import DRIVERS, DrawnFigure, Made, ReproductionSettings
from ethbrake_marl.extensions.reproduction.readings import OURS, READINGS, STATED, Reading
from ethbrake_marl.extensions.reproduction.strategies import (
    COUPLED,
    E_V2X_BM,
    NON_E,
    PREDICTED,
    SHIPPED_SPECS,
    avoided_text,
    drive,
    in_count,
    open_reading,
    proven_least_harm,
    strategies,
    times_above,
)
from ethbrake_marl.extensions.reproduction.verdicts import (
    Claim,
    Less,
    Result,
    Verdict,
    judge,
    judge_in_each,
    same_claim,
)
from ethbrake_marl.files.sheet import Column, Sheet
from ethbrake_marl.motion.layout import Bools, Floats

Lines = Mapping[str, Floats]  # strategy -> harm of each world, [n] m2/s2
Groups = Mapping[str, tuple[Lines, Bools]]  # group of worlds, or delay -> lines, and which worlds belong to it

DISTANCE, DISTANCE_WORLDS, ROOM_WORLDS = "paper-distance", 5_000, 1_000
ACTS_S = (0.1, 0.3, 0.5, 0.7)  # latencies of Vehicle 2, below that of Vehicle 3
ENDS_M = (10, 12, 14, 16, 18, 20)  # of the groups, for the sum of both gaps

EXPECTED, PROVEN = "E-V2X-BM, predicted", "least harm, proven"
LEGEND = (NON_E, E_V2X_BM, COUPLED, *SHIPPED_SPECS, EXPECTED, PROVEN)


def harm_of_strategies(reading: Reading, episodes: int) -> dict[str, dict[str, Floats]]:
    """Harm, count -> name -> [n] m2/s2, with that which E-V2X-BM predicts and, in ours, the proven lower bound."""
    of_counts = {}
    for count, outcomes in strategies(reading, episodes, SHIPPED_SPECS).items():
        of_counts[count] = {name: outcome["first"] for name, outcome in outcomes.items()}
        of_counts[count][EXPECTED] = outcomes[E_V2X_BM][PREDICTED]
    of_counts[OURS][PROVEN] = proven_least_harm(reading, episodes)
    return of_counts


def by_distance(reading: Reading, episodes: int, lines: Lines) -> Groups:
    group = np.digitize(open_reading(reading, episodes)[2].gaps_m.sum(axis=1), ENDS_M[1:-1])
    return {f"{ENDS_M[k]}-{ENDS_M[k + 1]} m": (lines, group == k) for k in np.unique(group).tolist()}


def less_in_each(groups: Groups, smaller: str, larger: str) -> list[Less]:
    return [
        Less.of_worlds(f"{smaller} minus {larger}, {group}", lines[smaller][rows], lines[larger][rows])
        for group, (lines, rows) in groups.items()
    ]


def show_harm(stem: str, title: str, readings: Mapping[str, Groups], legend: Sequence[str], x_label: str) -> Made:
    """``legend``: strategies in the figure."""
    estimates = {
        reading: {name: {group: mean(lines[name][rows]) for group, (lines, rows) in groups.items()} for name in names}
        for reading, groups in readings.items()
        for names in ([*next(iter(groups.values()))[0]],)
    }
    panels = {
        reading: {name: curve for name, curve in curves.items() if name in legend}
        for reading, curves in estimates.items()
    }
    text = "Mean harm of each strategy under each reading; bands: 95 % intervals."
    figure = curves_figure(panels, x_label, f"{title}. {text}", y_label=axis_title(FIRST_IMPACTS))
    sheets = [
        Sheet(
            f"{title}, {reading}",
            ("Strategy", *map(Column, readings[reading])),
            [(name, *curve.values()) for name, curve in curves.items()],
            "Harm, m²/s², with 95 % intervals.",
        )
        for reading, curves in estimates.items()
    ]
    return Made((), sheets, [DrawnFigure(stem, title, text, figure)])


def reproduce_distance(settings: ReproductionSettings) -> Made:
    """Figs. 4 and 8."""
    episodes = min(DISTANCE_WORLDS, settings.episodes)
    reading = STATED._replace(base=DISTANCE)
    readings = {
        count: by_distance(reading, episodes, lines) for count, lines in harm_of_strategies(reading, episodes).items()
    }
    named = {reading: statements(groups) | statements(groups, EXPECTED) for reading, groups in readings.items()}
    claims = [Claim(name, {reading: judge(parts[name]) for reading, parts in named.items()}) for name in named[OURS]]
    claims += [
        judge_in_each("Non-E grows", readings, partial(growth_between_groups, name=NON_E)),
        Claim("constant deceleration", {name: constant_result(groups) for name, groups in readings.items()}),
        Claim("advantage", {name: advantage_result(groups) for name, groups in readings.items()}),
        Claim("a2 above a3", capacity_results(episodes)),
        *(avoidance_by_distance(readings[OURS], policy) for policy in SHIPPED_SPECS),
        Claim("lower", {name: lower_result(groups) for name, groups in readings.items()}),
    ]
    title, label = "Harm by total distance", "Total distance d1 + d2 at the alert"
    return show_harm("harm-distance", title, readings, LEGEND, label)._replace(claims=claims, notes=[DRIVERS])


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


def constant_result(groups: Groups) -> Result:
    """At the shortest distance even the best constant deceleration does more harm than learned braking."""
    (distance, (lines, rows)), *_ = groups.items()
    best = COUPLED if COUPLED in lines else E_V2X_BM
    harm = {name: line[rows] for name, line in lines.items() if name in (E_V2X_BM, COUPLED, *SHIPPED_SPECS, PROVEN)}
    parts = [Less.of_worlds(f"{name} minus {best}", harm[name], harm[best]) for name in SHIPPED_SPECS]
    return judge(parts, f"{distance}: {', '.join(f'{name} {values.mean():.2f}' for name, values in harm.items())}")


def advantage_result(groups: Groups) -> Result:
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
    return judge(parts, f"minus E-V2X-BM, by distance: {'; '.join(texts)}")


def capacity_results(episodes: int) -> dict[str, Result]:
    """Verdict on why the harm of Non-E grows with the distance: Vehicle 2 can brake harder than Vehicle 3.

    Then the harm must fall with the distance if Vehicle 3 is the one that can brake harder.
    """
    results = {}
    for count in READINGS:
        ends = {}  # braking capacity of Vehicle 3 (m/s2; that of Vehicle 2 is 7) -> harm at shortest, longest distance
        for rear in (6.0, 7.0, 8.0):
            world = Reading(DISTANCE, others=(("braking_capacity_mps2", (6.0, 7.0, rear)),))
            harm = in_count(drive(world, "full_brake", episodes), count)["first"]
            (_, shortest), *_, (_, longest) = by_distance(world, episodes, {}).values()
            ends[rear] = harm[shortest], harm[longest]
        parts = [Less.of_lists("a3 = 6", *ends[6.0]), Less.of_lists("a3 = 8", *reversed(ends[8.0]))]
        texts = (f"a3 = {rear:g}: {near.mean():.2f} to {far.mean():.2f}" for rear, (near, far) in ends.items())
        results[count] = judge(parts, f"shortest to longest distance, {', '.join(texts)}")
    return results


def avoidance_by_distance(groups: Groups, policy: str) -> Claim:
    """At the distance at which a policy gains most, it avoids more collisions of E-V2X-BM than it adds.

    The same in every reading.
    """
    collided = {
        distance: [lines[name][rows] > 0.0 for name in (policy, E_V2X_BM)] for distance, (lines, rows) in groups.items()
    }
    changed = {distance: pair for distance, pair in collided.items() if (pair[0] != pair[1]).any()}
    gains = (
        Less.of_worlds(distance, driven.astype(np.float64), baseline.astype(np.float64))
        for distance, (driven, baseline) in changed.items()
    )
    most = sorted(gains, key=lambda gain: gain.difference.ends[1])[:1]
    text = "; ".join(f"{distance} {avoided_text(*pair)}" for distance, pair in collided.items())
    avoided = sum((baseline & ~driven).sum() for driven, baseline in collided.values())
    worlds = sum(len(driven) for driven, _ in collided.values())
    return Claim(f"{policy} avoids collisions", {OURS: judge(most, text)}, f"{100.0 * avoided / worlds:.1f} %")


def lower_result(groups: Groups) -> Result:
    """The hybrid does no more harm than the better of its two strategies in every world (Fig. 8)."""
    ((lines, _), *_) = groups.values()
    worse = {
        name: times_above(lines[f"Hybrid {name}"], np.minimum(lines[name], lines[E_V2X_BM])) for name in SHIPPED_SPECS
    }
    text = ", ".join(f"{count:,} (Hybrid {name})" for name, count in worse.items())
    verdict: Verdict = "differs" if any(worse.values()) else "agrees"
    return Result(f"not the lower in {text} of {len(lines[E_V2X_BM]):,} worlds", verdict)


def growth_between_groups(groups: Groups, name: str) -> list[Less]:
    harms = {group: lines[name][rows] for group, (lines, rows) in groups.items()}
    return [Less.of_lists(f"{lower} minus {higher}", harms[lower], harms[higher]) for lower, higher in pairwise(harms)]


DELAYS = ("low", "middle", "high")
PAPER_WORLD = (("gaps_m", (7.0, 7.0)), ("speeds_mps", (20.0, 18.0, 20.0)))  # the world of the paper's figure


def reproduce_delays(settings: ReproductionSettings) -> Made:
    """Fig. 5: at three delays, which are our choice, in the one world of the paper's figure."""
    readings: dict[str, dict[str, tuple[Lines, Bools]]] = {}
    for delay in DELAYS:
        reading = Reading(f"paper-delay-{delay}", others=PAPER_WORLD)
        _, middle, rear = open_reading(reading, 1)[2].latency_s[0]
        for count, lines in harm_of_strategies(reading, 1).items():
            readings.setdefault(count, {})[f"{delay} ({middle:g}, {rear:g} s)"] = lines, np.array([True])
    claims = [
        judge_in_each("learning harms least", readings, least_with_learning),
        Claim("robust", {name: robustness_result(groups) for name, groups in readings.items()}),
        room_claim(settings), time_claim(settings),
    ]  # fmt: skip
    title = "Gaps of 7 m, speeds of 20, 18 and 20 m/s"
    made = show_harm("harm-delays", title, readings, LEGEND, "Delay")
    return made._replace(claims=claims, notes=[f"One world: no intervals. {DRIVERS}"])


def least_with_learning(groups: Groups) -> list[Less]:
    (lines, _), *_ = groups.values()
    rivals = [name for name in (NON_E, E_V2X_BM, COUPLED) if name in lines]
    return [part for policy in SHIPPED_SPECS for rival in rivals for part in less_in_each(groups, policy, rival)]


def robustness_result(groups: Groups) -> Result:
    """From the low to the high delay, the harm of a policy grows less than that of constant decelerations.

    That of Non-E says little: it is large at the low delay already.
    """
    (low, _), *_, (high, _) = groups.values()
    rivals = [name for name in (E_V2X_BM, COUPLED) if name in low]
    growth = {name: high[name] - low[name] for name in (NON_E, *rivals, *SHIPPED_SPECS)}
    parts = [
        Less.of_worlds(f"{policy} minus {name}", growth[policy], growth[name])
        for policy in SHIPPED_SPECS
        for name in rivals
    ]
    return judge(parts, ", ".join(f"{name} {by.mean():+.2f}" for name, by in growth.items()))


def room_claim(settings: ReproductionSettings) -> Claim:
    """Always "undecided": at the high delay the room for learning is less as a share, and more in m2/s2."""
    episodes, shares = min(ROOM_WORLDS, settings.episodes), []
    for delay in ("low", "high"):
        reading = STATED._replace(base=f"paper-delay-{delay}")
        braking = drive(reading, "full_brake", episodes)["first"]
        shares.append(f"{delay} {proven_least_harm(reading, episodes).mean():.2f} of {braking.mean():.2f}")
    return same_claim("room", f"harm of Non-E that no strategy avoids, random test: {', '.join(shares)}", "undecided")


def time_claim(settings: ReproductionSettings) -> Claim:
    """The later Vehicle 2 acts, the more harm it does and the more is certain, if Vehicle 3 brakes at the same time."""
    episodes, results = min(ROOM_WORLDS, settings.episodes), {}
    readings = {f"{acts_s:g} s": STATED._replace(acts_s=acts_s) for acts_s in ACTS_S}
    for count in READINGS:
        harms = {
            policy: {at: in_count(drive(reading, spec, episodes), count)["first"] for at, reading in readings.items()}
            for policy, spec in SHIPPED_SPECS.items()
        }
        harms[PROVEN] = {at: proven_least_harm(reading, episodes) for at, reading in readings.items()}
        parts = [
            Less.of_worlds(f"{who}, {early} minus {late}", harm[early], harm[late])
            for who, harm in harms.items()
            for early, late in pairwise(harm)
        ]
        texts = [f"{who} {', '.join(f'{line.mean():.2f}' for line in harm.values())}" for who, harm in harms.items()]
        results[count] = judge(parts, f"harm if Vehicle 2 acts at {', '.join(readings)}: {'; '.join(texts)}")
    return Claim("time", results)
