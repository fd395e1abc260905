"""Harm against distance and delay: the figures ``Fig:Harm-ivds``, ``Fig:harm-delay`` and ``Fig:hybrid illu``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise

import numpy as np

from ethbrake_marl.evaluation.evaluate import Result
from ethbrake_marl.evaluation.statistics import difference, mean
from ethbrake_marl.extensions.report.curves import curves_figure
from ethbrake_marl.extensions.report.style import TITLES
from ethbrake_marl.extensions.reproduction.learning import unconverged
from ethbrake_marl.extensions.reproduction.made import POLICIES, Drawn, Made, Settings, about
from ethbrake_marl.extensions.reproduction.readings import (
    ABOUT_BASELINE,
    BASELINES,
    COUPLED,
    DISTANCE,
    FOUR,
    NON_ETHICAL,
    PPO,
    PREDICTED,
    PROVEN,
    READINGS,
    REALISED,
    SAC,
    Reading,
    drive,
    driven,
    harms,
    least_harm,
)
from ethbrake_marl.extensions.reproduction.verdicts import Less, Verdict, judge_statement
from ethbrake_marl.files.sheet import Column, Sheet
from ethbrake_marl.motion.layout import Floats

Groups = Mapping[str, Mapping[str, Floats]]  # group of worlds, or delay -> strategy -> harm of each world

DISTANCE_WORLDS, DELAY_WORLDS = 5_000, 2_000

ENDS_M = (10, 12, 14, 16, 18, 20)  # of the groups, for the sum of both gaps

ALONE, HYBRID_REALISED, HYBRID_PREDICTED = "policy alone", "hybrid, realised H*", "hybrid, predicted H*"


def by_distance(result: Result, harm: Mapping[str, Floats]) -> Groups:
    """Return the groups of worlds with similar sums of both gaps, ``10-12 m``, ...; none is empty."""
    total = np.asarray(result.worlds["gap_1_m"] + result.worlds["gap_2_m"])
    group = np.digitize(total, ENDS_M[1:-1])
    rows = {f"{ENDS_M[k]}-{ENDS_M[k + 1]} m": group == k for k in np.unique(group).tolist()}
    return {name: {who: each[some] for who, each in harm.items()} for name, some in rows.items()}


def less_in_each(groups: Groups, smaller: str, *larger: str) -> list[Less]:
    """Compare the harm of a strategy with that of others, in the same worlds of every group."""
    return [
        Less.of_worlds(group if len(larger) == 1 else f"{group}, {other}", harm[smaller], harm[other])
        for group, harm in groups.items()
        for other in larger
    ]


def show_harm(
    stem: str, title: str, readings: Mapping[str, tuple[Groups, str]], lines: Sequence[str], x_label: str
) -> tuple[Drawn, list[Sheet]]:
    """Return a figure of mean harm, with a panel for each reading, and a table for each.

    ``readings`` has groups and a note by reading; ``lines`` are the strategies of the figure.
    """
    panels = {
        reading: {line: {group: mean(harm[line]) for group, harm in groups.items()} for line in lines}
        for reading, (groups, _) in readings.items()
    }
    text = "Mean first-impact harm of each strategy under each reading; bands: 95 % intervals."
    figure = curves_figure(panels, x_label, f"{title}. {text}", y_label=TITLES["first"])
    sheets = []
    for reading, (groups, note) in readings.items():
        strategies = next(iter(groups.values()))
        rows = [(strategy, *(mean(harm[strategy]) for harm in groups.values())) for strategy in strategies]
        columns = [Column(group) for group in groups]
        below = f"First-impact harm, m²/s²; {note} {ABOUT_BASELINE}"
        sheets.append(Sheet(f"{title}, {reading}", ("Strategy", *columns), rows, below))
    return Drawn(stem, title, text, figure), sheets


def over_distance(stem: str, readings: Mapping[str, tuple[Groups, str]], lines: Sequence[str]) -> Made:
    """Return figure and tables of harm against the sum of both gaps."""
    title, x_label = "Harm by total distance", "Total distance d1 + d2 at the alert"
    figure, sheets = show_harm(stem, title, readings, lines, x_label)
    return Made([], sheets, [figure])


def reproduce_distance(settings: Settings) -> Made:
    """Reproduce the figure of harm against the sum of both gaps."""
    readings, verdicts = {}, []
    for reading in READINGS:
        result, least = driven(DISTANCE, reading, tuple(FOUR.items()), min(DISTANCE_WORLDS, settings.episodes))
        groups = by_distance(result, harms(result, least))
        readings[reading.name] = groups, about(result)
        claims = {
            "non-ethical: the larger the distance, the larger the harm": [
                Less.of_lists(f"{one} to {other}", groups[one][NON_ETHICAL], groups[other][NON_ETHICAL])
                for one, other in pairwise(groups)
            ]
        }
        claims |= {f"{name} harms less than non-ethical": less_in_each(groups, name, NON_ETHICAL) for name in BASELINES}
        claims |= {
            f"{policy} harms less than {name} over the whole range": less_in_each(groups, policy, name)
            for policy in (SAC, PPO)
            for name in BASELINES
        }
        verdicts += [judge_statement(f"{claim} ({reading.name})", parts) for claim, parts in claims.items()]
    shown = over_distance("harm-distance", readings, [*FOUR, PREDICTED, PROVEN])
    return shown._replace(verdicts=verdicts, notes=[POLICIES])


DELAYS = ("low", "middle", "high")
ONE = "d = 7, 7 m; v = 20, 18, 20 m/s"  # the world of the paper's figure
LIST = "d = 5-10 m; v = 18-22 m/s"
STATE = {"gaps_m": [7, 7], "speeds_mps": [20, 18, 20]}


def reproduce_delays(settings: Settings) -> Made:
    """Reproduce the figure of harm at three delays: in its single world, and over random worlds beside it."""
    verdicts, figures, sheets = list[Verdict](), [], list[Sheet]()
    many = min(DELAY_WORLDS, settings.episodes)
    for worlds, changes, episodes, stem in ((ONE, STATE, 1, "world"), (LIST, {}, many, "list")):
        readings: dict[str, tuple[Groups, str]] = {}
        for reading in READINGS:
            groups = {}
            for delay in DELAYS:
                scenario = reading.scenario(f"paper-delay-{delay}", **changes)
                result = drive(scenario, FOUR, episodes)
                _, middle, rear = scenario.model_dump()["latency_s"]
                groups[f"{delay} ({middle:g}, {rear:g} s)"] = harms(result, least_harm(scenario, episodes))
            readings[reading.name] = groups, "one world has no interval." if episodes == 1 else about(result)
            verdicts += [  # "consistently achieve the lowest harm values across all tested delay setting"
                judge_statement(
                    f"{policy} harms less than non-ethical and E-V2X-BM at every delay ({worlds}; {reading.name})",
                    less_in_each(groups, policy, NON_ETHICAL, *BASELINES),
                )
                for policy in (SAC, PPO)
            ]
        lines = [*FOUR, PREDICTED, PROVEN]
        x_label = "Delay (τ2, τ3)"
        figure, own = show_harm(f"harm-delays-{stem}", worlds, readings, lines, x_label)
        figures.append(figure)
        sheets += own
    note = f"The delays are our choice. {POLICIES} They were not trained at these delays."
    return Made(verdicts, sheets, figures, notes=[note])


def drive_hybrid(name: str, settings: Settings, reading: Reading) -> tuple[Result, Floats]:
    """Let E-V2X-BM, a policy that has not converged, and Algorithm 1 with both H* drive. Figure and table share it."""
    policy = unconverged(settings.folder)
    agents = {
        REALISED: FOUR[REALISED],
        COUPLED: FOUR[COUPLED],
        ALONE: policy,
        HYBRID_REALISED: f"{policy}+episode",
        HYBRID_PREDICTED: f"{policy}+episode:pairwise",
    }
    return driven(name, reading, tuple(agents.items()), min(DISTANCE_WORLDS, settings.episodes))


def reproduce_illustration(settings: Settings) -> Made:
    """Reproduce the illustration of the hybrid, which "consistently selects the strategy [of] lower harm"."""
    readings, verdicts = {}, []
    for reading in READINGS:
        result, least = drive_hybrid(DISTANCE, settings, reading)
        harm = harms(result, least)
        groups = by_distance(result, harm)
        readings[reading.name] = groups, about(result)
        for name, baseline in ((HYBRID_REALISED, COUPLED), (HYBRID_PREDICTED, REALISED)):
            lower = np.minimum(harm[ALONE], harm[baseline])
            worse = harm[name] > lower + 1e-9
            because = (
                f"in {int(worse.sum()):,} of {len(worse):,} worlds the {name} harms more than the lower of policy and"
                f" {baseline}; mean excess {difference(harm[name], lower).in_words()}"
            )
            what = f"the {name} takes the lower of the two ({reading.name})"
            verdicts.append(Verdict(what, "differs" if worse.any() else "agrees", because))
        for other in (ALONE, COUPLED):
            what = f"the {HYBRID_REALISED} harms no more than {other} at every distance ({reading.name})"
            parts = less_in_each(groups, HYBRID_REALISED, other)
            verdicts.append(judge_statement(what, parts, or_equal=True))
    lines = [REALISED, COUPLED, ALONE, HYBRID_REALISED, HYBRID_PREDICTED, PREDICTED]
    return over_distance("hybrid-illustration", readings, lines)._replace(verdicts=verdicts)
