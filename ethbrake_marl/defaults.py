"""Defaults and choices of the options of the command line, apart from what works with them: --help imports no numpy."""

from __future__ import annotations

from typing import Literal, get_args

EPISODES = 10_000
LIST_SEED = 7  # of the worlds on which everything is measured; has nothing to do with the seed of a training

HarmCount = Literal["first", "total"]
HARM_COUNTS: tuple[HarmCount, ...] = get_args(HarmCount)

UNCERTAINTY_EXAMPLE = "braking_capacity_mps2=5%,latency_s=0.1,gaps_m.pair_1=0.5"

SEARCH_BUDGET = 100_000  # candidates per world and count, of ``best-harm``

DatasetFormat = Literal["parquet", "minari"]

MeasureName = Literal["harm", "regret", "difference", "bound"]  # what ``falsify`` searches for
MEASURES: tuple[MeasureName, ...] = get_args(MeasureName)
HINDSIGHT = "best_harm"  # the reference of regret, unless another is given
MOST_NAMED_WORLDS = 1000  # of a file
