"""The paper's figure of harm over total distance (``Fig:Harm-ivds``)."""

from __future__ import annotations

from ethbrake_marl.evaluation.statistics import unpaired_difference
from ethbrake_marl.figures.reproduction import lines_figure
from ethbrake_marl.studies.reproduction.item import (
    Drawn,
    Made,
    Parameter,
    Settings,
    Table,
    csv_text,
    list_parameter,
    scenario_parameters,
)
from ethbrake_marl.studies.reproduction.measure import (
    ABOUT_BASELINE,
    ABOUT_POLICIES,
    COUPLED,
    FOUR,
    FULL_BRAKE,
    NAMES,
    PAIRWISE,
    PPO,
    PREDICTED,
    PROVEN,
    READINGS,
    SAC,
    Grouped,
    Reading,
    drive_list,
    group_by_distance,
    lineup,
    read_scenario,
)
from ethbrake_marl.studies.reproduction.verdicts import HARM, Less, Verdict, judge_statement

_SCENARIO, _WORLDS = "paper-distance", 5_000
X_LABEL, Y_LABEL = "Total distance d1 + d2 at the alert (m)", "First-impact harm (m²/s²)"


def reproduce_distance(settings: Settings) -> Made:
    """Harm of the four strategies over the total distance."""
    episodes = settings.worlds(_WORLDS)
    found = {}
    for reading in READINGS:
        scenario = read_scenario(_SCENARIO, reading)
        found[reading] = group_by_distance(drive_list(scenario, lineup(FOUR, scenario), episodes, settings))
    verdicts = [each for reading, grouped in found.items() for each in _judge(reading, grouped)]
    parameters = (
        *scenario_parameters(read_scenario(_SCENARIO, READINGS[0]), gaps_m="5 to 10 m, text to Table:hybrid"),
        Parameter("distances", "each gap drawn on its own, then grouped by the sum", ""),
        Parameter("harm", "each pair's first impact", "sec:result, Experimental Set-Up"),
        Parameter("policies", f"{ABOUT_POLICIES}; not the paper's", ""),
        list_parameter(episodes),
    )
    return Made(
        tuple(verdicts),
        parameters,
        tuple(distance_table(reading.name, grouped) for reading, grouped in found.items()),
        (distance_figure("harm-distance", found, [*(NAMES[spec] for spec in FOUR), PREDICTED, PROVEN], episodes),),
        {"harm-distance": distance_csv(found)},
    )


def distance_figure(stem: str, found: dict[Reading, Grouped], strategies: list[str], episodes: int) -> Drawn:
    """One panel per reading, one line per strategy."""
    panels = {reading.name: {name: grouped.line(name) for name in strategies} for reading, grouped in found.items()}
    caption = f"Means over {episodes:,} worlds in groups of 2 m; bands: 95 % intervals."
    figure = lines_figure(panels, x_label=X_LABEL, y_label=Y_LABEL, caption=caption)
    text = "Mean harm of each strategy against the sum of both gaps; left as the paper states it, right with Vehicle 2"
    return Drawn(stem, "Harm over total distance", f"{text} acting at 0.2 s.", figure)


def distance_table(title: str, grouped: Grouped) -> Table:
    """Harm with its interval: one row per strategy, one column per group."""
    rows = tuple(
        (name, *(HARM.estimate(grouped.estimate(name, k)) for k in range(len(grouped.groups)))) for name in grouped.harm
    )
    note = f"First-impact harm, m²/s², with 95 % intervals. {ABOUT_BASELINE}"
    return Table(f"Harm by total distance, {title}", ("Strategy", *grouped.groups), rows, note)


def distance_csv(found: dict[Reading, Grouped]) -> str:
    """One row per reading, strategy and group."""
    rows = []
    for reading, grouped in found.items():
        for name in grouped.harm:
            for k, group in enumerate(grouped.groups):
                estimate = grouped.estimate(name, k)
                low, high = estimate.interval or ("", "")
                count = int(grouped.rows[k].sum())
                rows.append([reading.name, name, group, grouped.at_m[k], count, estimate.value, low, high])
    head = ("reading", "strategy", "total_distance", "mean_distance_m", "worlds", "first_impact_harm", "low", "high")
    return csv_text(head, rows)


def _judge(reading: Reading, grouped: Grouped) -> list[Verdict]:
    """The paper's statements about the figure."""

    def judge(statement: str, parts: list[Less]) -> Verdict:
        return judge_statement(f"{statement} ({reading.name})", parts)

    braking = NAMES[FULL_BRAKE]
    baselines = (NAMES[PAIRWISE], NAMES[COUPLED], PREDICTED)
    rising = [
        Less(
            f"{grouped.groups[k]} to {grouped.groups[k + 1]}",
            unpaired_difference(
                grouped.estimate(braking, k),
                int(grouped.rows[k].sum()),
                grouped.estimate(braking, k + 1),
                int(grouped.rows[k + 1].sum()),
            ),
        )
        for k in range(len(grouped.groups) - 1)
    ]
    return [
        judge("non-ethical: the larger the distance, the larger the harm", rising),
        *(judge(f"{name} harms less than non-ethical", grouped.less(name, braking)) for name in baselines),
        *(
            judge(f"{NAMES[policy]} harms less than {name} over the whole range", grouped.less(NAMES[policy], name))
            for policy in (SAC, PPO)
            for name in baselines
        ),
    ]
