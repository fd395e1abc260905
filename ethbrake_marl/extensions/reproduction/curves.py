"""Harm against distance and delay: the figures ``Fig:Harm-ivds``, ``Fig:harm-delay`` and ``Fig:hybrid illu``."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from itertools import pairwise

import numpy as np

from ethbrake_marl.evaluation.statistics import mean
from ethbrake_marl.extensions.report.figures import curves_figure
from ethbrake_marl.extensions.report.style import TITLES
from ethbrake_marl.extensions.reproduction.learning import unconverged
from ethbrake_marl.extensions.reproduction.made import Drawn, Made, Settings
from ethbrake_marl.extensions.reproduction.random_test import E_V2X_BM, NON_E, WORLDS, opened
from ethbrake_marl.extensions.reproduction.readings import NEAREST, STATED, Reading
from ethbrake_marl.extensions.reproduction.strategies import (
    COUPLED,
    MAP_STEP_S,
    PAPERS,
    PREDICTED,
    SIMULATED,
    least_harm,
    of_the_process,
    strategies,
)
from ethbrake_marl.extensions.reproduction.verdicts import Claim, Less, Outcome, judge
from ethbrake_marl.files.sheet import Column, Estimate, Sheet
from ethbrake_marl.motion.layout import Floats

Lines = Mapping[str, Floats]  # strategy -> first-impact harm of each world, [n], or of each seed and world, [seeds, n]
Groups = Mapping[str, tuple[Lines, Floats]]  # group of worlds, or delay -> lines, and the places of its worlds

DISTANCE, DISTANCE_WORLDS = "paper-distance", 5_000
ENDS_M = (10, 12, 14, 16, 18, 20)  # of the groups, for the sum of both gaps

EXPECTED, PROVEN, ALONE = "E-V2X-BM, predicted", "least harm, proven", "PPO, not converged"


def lines_of(reading: Reading, episodes: int, policies: Mapping[str, str]) -> dict[str, Floats]:
    """First-impact harm of each strategy under a reading of the paper's text: strategy -> [n] m2/s2.

    ``policies``: name -> agent name. What E-V2X-BM predicts and, for exact impacts, the proven bound are included.
    """
    found = strategies(reading, episodes, policies)
    lines = {name: each["first"] for name, each in found.items()} | {EXPECTED: found[E_V2X_BM][PREDICTED]}
    return lines | ({PROVEN: least_harm(reading, episodes)} if reading.step_s is None else {})


def process_lines(reading: Reading, episodes: int, settings: Settings) -> dict[str, Floats]:
    """Harm in the paper's fixed-step map, with policies trained as in the paper: strategy -> [seeds, n].

    In m2/s2. Strategies without a policy have [n]. Empty without such trainings.
    """
    found = of_the_process(reading, episodes, settings)
    trained = {name: np.stack([seed[name]["first"] for seed in seeds]) for name, seeds in found.items()}
    return {**lines_of(reading._replace(step_s=MAP_STEP_S), episodes, {}), **trained} if found else {}


def estimate(line: Floats, rows: Floats) -> Estimate:
    """Mean of the harm ``line``, [n] or [seeds, n], in the worlds ``rows``, with a 95 % interval.

    The interval is over the worlds or, if there are several seeds, over the seeds.
    """
    return mean(line[rows]) if line.ndim == 1 else mean(line[:, rows].mean(axis=1))


def by_distance(reading: Reading, episodes: int, lines: Lines) -> Groups:
    group = np.digitize(opened(reading.only(*WORLDS), episodes)[2].gaps_m.sum(axis=1), ENDS_M[1:-1])
    return {f"{ENDS_M[k]}-{ENDS_M[k + 1]} m": (lines, group == k) for k in np.unique(group).tolist()}


def less_in_each(groups: Groups, smaller: str, larger: str) -> list[Less]:
    return [
        Less.of_worlds(f"{smaller} minus {larger}, {group}", lines[smaller][rows], lines[larger][rows])
        for group, (lines, rows) in groups.items()
    ]


def show_harm(stem: str, title: str, readings: Mapping[str, Groups], shown: Sequence[str], x_label: str) -> Made:
    """Figure of mean harm, with a panel for each reading of the paper, and a table for each.

    ``readings``: name of the reading -> ``Groups`` of worlds. ``shown``: strategies that the figure shows. ``stem``: of
    its file's name.
    """
    estimates = {
        reading: {
            name: {group: estimate(lines[name], rows) for group, (lines, rows) in groups.items()} for name in names
        }
        for reading, groups in readings.items()
        for names in ([*next(iter(groups.values()))[0]],)
    }
    panels = {
        reading: {name: curve for name, curve in curves.items() if name in shown}
        for reading, curves in estimates.items()
    }
    text = "Mean first-impact harm of each strategy under each reading; bands: 95 % intervals."
    figure = curves_figure(panels, x_label, f"{title}. {text}", y_label=TITLES["first"])
    sheets = [
        Sheet(
            f"{title}, {reading}",
            ("Strategy", *map(Column, readings[reading])),
            [(name, *curve.values()) for name, curve in curves.items()],
            "First-impact harm, m²/s², with 95 % intervals.",
        )
        for reading, curves in estimates.items()
    ]
    return Made((), sheets, [Drawn(stem, title, text, figure)])


def over_distance(stem: str, readings: Mapping[str, Groups], shown: Sequence[str]) -> Made:
    return show_harm(stem, "Harm by total distance", readings, shown, "Total distance d1 + d2 at the alert")


def distances(settings: Settings, policies: Mapping[str, str]) -> dict[str, Groups]:
    episodes, found = min(DISTANCE_WORLDS, settings.episodes), {}
    for name, reading in (("as stated", STATED), ("nearest reading", NEAREST)):
        there = reading._replace(base=DISTANCE)
        found[name] = by_distance(there, episodes, lines_of(there, episodes, policies))
    return found


def reproduce_distance(settings: Settings) -> Made:
    readings = distances(settings, settings.policies)
    stated, nearest = (statements(groups, settings.policies) for groups in readings.values())
    there, episodes = STATED._replace(base=DISTANCE), min(DISTANCE_WORLDS, settings.episodes)
    if lines := process_lines(there, episodes, settings):
        readings[PAPERS] = by_distance(there, episodes, lines)
    why = "where gaps are short, the deceleration that E-V2X-BM plans does far more harm than it predicts"
    whys = {"E-V2X-BM does less harm than non-ethical": why}
    claims = [judge("Fig. 4", text, parts, nearest[text], why=whys.get(text, "")) for text, parts in stated.items()]
    shown = over_distance("harm-distance", readings, [NON_E, E_V2X_BM, COUPLED, *settings.policies, EXPECTED, PROVEN])
    return shown._replace(claims=claims, notes=[settings.who_drives])


def statements(groups: Groups, policies: Iterable[str]) -> dict[str, list[Less]]:
    lines, shortest = next(iter(groups.values()))
    half = 0.5 * lines[NON_E][shortest]
    return {
        "non-ethical harm grows with the distance": growing(groups, NON_E),
        "E-V2X-BM does less harm than non-ethical": less_in_each(groups, E_V2X_BM, NON_E),
        "E-V2X-BM still does much harm (more than half of non-ethical) at the shortest distance": [
            Less.of_worlds("half of Non-E minus E-V2X-BM", half, lines[E_V2X_BM][shortest])
        ],
        "SAC and PPO do less harm than E-V2X-BM over the whole range": [
            part for policy in policies for part in less_in_each(groups, policy, E_V2X_BM)
        ],
    }


def growing(groups: Groups, name: str) -> list[Less]:
    each = {group: lines[name][rows] for group, (lines, rows) in groups.items()}
    return [Less.of_lists(f"{one} minus {other}", each[one], each[other]) for one, other in pairwise(each)]


DELAYS = ("low", "middle", "high")
ONE = (("gaps_m", (7.0, 7.0)), ("speeds_mps", (20.0, 18.0, 20.0)))  # the world of the paper's figure


def reproduce_delays(settings: Settings) -> Made:
    """Reproduce the harm at three delays, which we chose, in the single world of the paper's figure."""
    groups, trained, one = {}, {}, np.array([True])
    for delay in DELAYS:
        reading = STATED._replace(base=f"paper-delay-{delay}", others=ONE)
        _, middle, rear = opened(reading.only(*WORLDS), 1)[2].latency_s[0]
        name = f"{delay} ({middle:g}, {rear:g} s)"
        groups[name] = lines_of(reading, 1, settings.policies), one
        trained[name] = process_lines(reading, 1, settings), one
    parts = [
        part
        for policy in settings.policies
        for other in (NON_E, E_V2X_BM, COUPLED)
        for part in less_in_each(groups, policy, other)
    ]
    readings = {"as stated": groups} | ({PAPERS: trained} if all(lines for lines, _ in trained.values()) else {})
    claim = judge("Fig. 5", "SAC and PPO do the least harm at every delay (the delays are ours)", parts)
    shown = [NON_E, E_V2X_BM, COUPLED, *settings.policies, EXPECTED, PROVEN]
    made = show_harm("harm-delays", "Gaps of 7 m, speeds of 20, 18 and 20 m/s", readings, shown, "Delay")
    return made._replace(claims=[claim], notes=[f"One world: no intervals. {settings.who_drives}"])


def reproduce_illustration(settings: Settings) -> Made:
    readings = distances(settings, {ALONE: unconverged(settings.folder)})
    hybrid = f"Hybrid {ALONE}"
    counts, shares, texts = [], [], []
    for groups in readings.values():
        lines = next(iter(groups.values()))[0]
        shares.append(lines[EXPECTED].mean() / lines[E_V2X_BM].mean())
        worse = lines[hybrid] > np.minimum(lines[ALONE], lines[E_V2X_BM]) + 1e-9
        counts.append(int(worse.sum()))
        texts.append(f"not in {counts[-1]:,} of {len(worse):,} worlds")
    ours, nearest = texts
    why = (
        f"it compares the policy's harm with the harm that E-V2X-BM predicts, {100.0 * shares[0]:.0f} % of what it"
        " does; with the simulated H* it always takes the lower one"
    )
    outcome: Outcome = "differs" if counts[0] else "agrees"
    text, why = "the hybrid consistently selects the strategy of lower harm", why if counts[0] else ""
    claim = Claim("Fig. 8", text, ours, nearest, outcome, why)
    shown = over_distance("hybrid-illustration", readings, [E_V2X_BM, COUPLED, ALONE, hybrid, f"{hybrid}, {SIMULATED}"])
    return shown._replace(claims=[claim])
