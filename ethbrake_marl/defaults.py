"""Defaults and choices of the options of the command line, apart from what works with them: --help imports no numpy."""

from __future__ import annotations

from typing import Literal, NamedTuple, get_args

HarmCount = Literal["first", "total"]
HARM_COUNTS: tuple[HarmCount, ...] = get_args(HarmCount)

DatasetFormat = Literal["parquet", "minari"]
DataFormat = Literal["highd", "ngsim", "openacc"]  # of recorded traffic
DataDraw = Literal["rows", "normal", "lognormal", "quantiles"]  # how worlds are drawn from it

MeasureName = Literal["harm", "regret", "difference", "bound"]  # what ``falsify`` searches for


class _Defaults(NamedTuple):
    """What an option is where it is not given."""

    EPISODES: int = 10_000
    LIST_SEED: int = 7  # of the worlds on which everything is measured; has nothing to do with the seed of a training
    UNCERTAINTY_EXAMPLE: str = "braking_capacity_mps2=5%,latency_s=0.1,gaps_m.pair_1=0.5"
    SEARCH_BUDGET: int = 100_000  # candidates per world and count, of ``best-harm``
    HINDSIGHT: str = "best_harm"  # the reference of regret, unless another is given
    MOST_NAMED_WORLDS: int = 1000  # of a file


DEFAULT = _Defaults()
