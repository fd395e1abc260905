"""The ends of learning curves without the curves: what finished policies reach at high and low delay."""

from __future__ import annotations

from typing import NamedTuple

from ethbrake_marl.evaluation.statistics import mean, unpaired_difference
from ethbrake_marl.physics import Floats
from ethbrake_marl.studies.reproduction.item import Settings, Table, csv_text
from ethbrake_marl.studies.reproduction.measure import (
    FULL_BRAKE,
    NAMES,
    PPO,
    PROVEN,
    READINGS,
    SAC,
    UNIVERSAL,
    drive_list,
    harms,
    lineup,
    read_scenario,
)
from ethbrake_marl.studies.reproduction.verdicts import HARM, Less, Verdict, judge_statement

_WORLDS = 2_000
_SPECS = (PPO, SAC, UNIVERSAL, FULL_BRAKE)
_DELAYS = ("low", "high")


class Ends(NamedTuple):
    """Verdicts, tables and data."""

    verdicts: tuple[Verdict, ...]
    tables: tuple[Table, ...]
    data: dict[str, str]


def shipped_ends(settings: Settings) -> Ends:
    """Harm of shipped policies at both delays, in both readings of when Vehicle 2 acts."""
    episodes = settings.worlds(_WORLDS)
    verdicts, rows, raw = [], [], []
    for reading in READINGS:
        found: dict[str, dict[str, Floats]] = {}
        for delay in _DELAYS:
            scenario = read_scenario(f"paper-delay-{delay}", reading)
            found[delay] = harms(drive_list(scenario, lineup(_SPECS, scenario), episodes, settings))
        low, high = (found[delay] for delay in _DELAYS)
        for name in low:
            rows.append((reading.name, name, HARM.estimate(mean(low[name])), HARM.estimate(mean(high[name]))))
            raw += [[reading.name, name, delay, episodes, float(found[delay][name].mean())] for delay in _DELAYS]
        parts = [
            Less(name, unpaired_difference(mean(low[name]), episodes, mean(high[name]), episodes))
            for name in low
            if name not in (NAMES[FULL_BRAKE], PROVEN)
        ]
        what = f"finished policies harm less at low delay than at high ({reading.name})"
        verdicts.append(judge_statement(what, parts))
    note = (
        f"First-impact harm, m²/s², {episodes:,} worlds of seed 7 each. PPO and SAC were trained at 0.5 and 0.8 s,"
        " universal for all latencies; none at these delays alone."
    )
    head = ("Reading", "Strategy", "Low delay", "High delay")
    table = Table("What finished policies reach", head, tuple(rows), note)
    data = csv_text(("reading", "strategy", "delay", "worlds", "first_impact_harm"), raw)
    return Ends(tuple(verdicts), (table,), {"finished-policies": data})
