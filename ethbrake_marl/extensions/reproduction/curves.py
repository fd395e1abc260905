"""Harm against distance and delay: the figures ``Fig:Harm-ivds``, ``Fig:harm-delay`` and ``Fig:hybrid illu``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise

import numpy as np

from ethbrake_marl.evaluation.evaluate import Result
from ethbrake_marl.evaluation.statistics import difference, mean
from ethbrake_marl.extensions.reproduction.figures import estimates_figure
from ethbrake_marl.extensions.reproduction.limits import least_harm
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
)
from ethbrake_marl.extensions.reproduction.trainings import unconverged
from ethbrake_marl.extensions.reproduction.verdicts import Less, Verdict, judge_statement
from ethbrake_marl.files.sheet import Column, Sheet
from ethbrake_marl.motion.layout import Floats

Groups = Mapping[str, Mapping[str, Floats]]  # group of worlds -> strategy -> harm of each world

HARM_TITLE = "First-impact harm (m²/s²)"

DISTANCE_WORLDS, DELAY_WORLDS = 5_000, 2_000

ENDS_M = (10.0, 12.0, 14.0, 16.0, 18.0, 20.0)  # of the groups, for the sum of both gaps

ALONE, HYBRID_REALISED, HYBRID_PREDICTED = "policy alone", "hybrid, realised H*", "hybrid, predicted H*"


def by_distance(result: Result, harm: Mapping[str, Floats]) -> tuple[list[float], Groups]:
    """Return the mean sum of both gaps (m) of each group of worlds, and the groups ``10-12 m``, ...; none is empty."""
    total = np.asarray(result.worlds["gap_1_m"] + result.worlds["gap_2_m"])
    inner = np.digitize(total, ENDS_M[1:-1])
    rows = {f"{low:g}-{high:g} m": inner == k for k, (low, high) in enumerate(pairwise(ENDS_M))}
    rows = {name: mask for name, mask in rows.items() if mask.any()}
    groups = {name: {who: each[mask] for who, each in harm.items()} for name, mask in rows.items()}
    return [float(total[mask].mean()) for mask in rows.values()], groups


def less_in_each(groups: Groups, smaller: str, *larger: str) -> list[Less]:
    """Compare the harm of a strategy with that of others, in the same worlds of every group."""
    return [
        Less.of_worlds(group if len(larger) == 1 else f"{group}, {other}", harm[smaller], harm[other])
        for group, harm in groups.items()
        for other in larger
    ]


def harm_sheet(title: str, groups: Groups, note: str) -> Sheet:
    """Return mean harms: a row for each strategy, a column for each group."""
    names = dict.fromkeys(name for harm in groups.values() for name in harm)
    rows = [(name, *(mean(harm[name]) if name in harm else None for harm in groups.values())) for name in names]
    columns = [Column(group) for group in groups]
    return Sheet(title, ("Strategy", *columns), rows, f"First-impact harm, m²/s²; {note} {ABOUT_BASELINE}")


def over_distance(
    stem: str, curves: Mapping[str, tuple[Sequence[float], Groups, str]], lines: Sequence[str]
) -> tuple[Drawn, list[Sheet]]:
    """Return the figure of harm against the sum of both gaps, and its tables.

    ``curves`` has distances, groups and a note by reading; ``lines`` are the strategies of the figure.
    """
    panels = {
        reading: {name: {x: mean(harm[name]) for x, harm in zip(at, groups.values(), strict=True)} for name in lines}
        for reading, (at, groups, _) in curves.items()
    }
    worlds = sum(len(next(iter(harm.values()))) for harm in next(iter(curves.values()))[1].values())
    figure = estimates_figure(
        panels,
        HARM_TITLE,
        f"Means over {worlds:,} worlds in groups of 2 m; bands: 95 % intervals.",
        "Total distance d1 + d2 at the alert (m)",
    )
    text = (
        "Mean harm of each strategy against the sum of both gaps; left as stated, right with Vehicle 2 acting at 0.2 s."
    )
    sheets = [harm_sheet(f"Harm by total distance, {name}", groups, note) for name, (_, groups, note) in curves.items()]
    return Drawn(stem, "Harm over total distance", text, figure), sheets


def reproduce_distance(settings: Settings) -> Made:
    """Reproduce the figure of harm against the sum of both gaps."""
    curves, verdicts = {}, []
    for reading in READINGS:
        result = driven(DISTANCE, reading, FOUR, min(DISTANCE_WORLDS, settings.episodes))
        harm = harms(result) | {PROVEN: least_harm(reading.scenario(DISTANCE), result)}
        at, groups = by_distance(result, harm)
        curves[reading.name] = at, groups, about(result)
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
    figure, sheets = over_distance("harm-distance", curves, [*FOUR, PREDICTED, PROVEN])
    return Made(verdicts, sheets, [figure], notes=[POLICIES])


DELAYS = ("low", "middle", "high")
ONE = "d = 7, 7 m; v = 20, 18, 20 m/s"  # the world of the paper's figure
LIST = "d = 5-10 m; v = 18-22 m/s"
STATE = {"gaps_m": [7, 7], "speeds_mps": [20, 18, 20]}


def reproduce_delays(settings: Settings) -> Made:
    """Reproduce the figure of harm at three delays: in its single world, and over random worlds beside it."""
    verdicts, figures, sheets = [], [], []
    for worlds, changes, episodes, stem in (
        (ONE, STATE, 1, "world"),
        (LIST, {}, min(DELAY_WORLDS, settings.episodes), "list"),
    ):
        panels = {}
        for reading in READINGS:
            groups: dict[str, dict[str, Floats]] = {}
            for delay in DELAYS:
                scenario = reading.scenario(f"paper-delay-{delay}", **changes)
                result = drive(scenario, FOUR, episodes)
                _, middle, rear = scenario.model_dump()["latency_s"]
                groups[f"{delay} ({middle:g}, {rear:g} s)"] = harms(result) | {PROVEN: least_harm(scenario, result)}
            where = f"{worlds}; {reading.name}"
            panels[reading.name] = {
                name: {at: mean(harm[name]) for at, harm in zip(DELAYS, groups.values(), strict=True)}
                for name in next(iter(groups.values()))
            }
            sheets.append(harm_sheet(where, groups, "one world has no interval." if episodes == 1 else about(result)))
            verdicts += [  # "consistently achieve the lowest harm values across all tested delay setting"
                judge_statement(
                    f"{policy} harms less than non-ethical and E-V2X-BM at every delay ({where})",
                    less_in_each(groups, policy, NON_ETHICAL, *BASELINES),
                )
                for policy in (SAC, PPO)
            ]
        caption = f"{worlds}. Low, middle, high: τ3 = 0.3, 0.6, 1.2 s; left τ2 = 0.1, 0.3, 0.8 s. Bars: 95 % intervals."
        text = f"Harm of each strategy at three delays, {worlds}."
        figure = estimates_figure(panels, HARM_TITLE, caption)
        figures.append(Drawn(f"harm-delays-{stem}", "Harm at three delays", text, figure))
    note = f"The delays are our choice. {POLICIES} They were not trained at these delays."
    return Made(verdicts, sheets, figures, notes=[note])


def drive_hybrid(name: str, settings: Settings, reading: Reading) -> Result:
    """Let E-V2X-BM, a policy that has not converged, and Algorithm 1 with both H* drive. Figure and table share it."""
    policy = unconverged(settings)
    agents = {
        REALISED: FOUR[REALISED],
        COUPLED: FOUR[COUPLED],
        ALONE: policy,
        HYBRID_REALISED: f"{policy}+episode",
        HYBRID_PREDICTED: f"{policy}+episode:pairwise",
    }
    return driven(name, reading, agents, min(DISTANCE_WORLDS, settings.episodes))


def reproduce_illustration(settings: Settings) -> Made:
    """Reproduce the illustration of the hybrid, which "consistently selects the strategy [of] lower harm"."""
    curves, verdicts = {}, []
    for reading in READINGS:
        result = drive_hybrid(DISTANCE, settings, reading)
        harm = harms(result)
        at, groups = by_distance(result, harm)
        curves[reading.name] = at, groups, about(result)
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
            verdicts.append(judge_statement(what, less_in_each(groups, HYBRID_REALISED, other), or_equal=True))
    lines = [REALISED, COUPLED, ALONE, HYBRID_REALISED, HYBRID_PREDICTED, PREDICTED]
    figure, sheets = over_distance("hybrid-illustration", curves, lines)
    return Made(verdicts, sheets, [figure])
