"""Settings and results of an *item* of the reproduction, which is a figure or a table of the paper."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from matplotlib.figure import Figure

from ethbrake_marl.extensions.reproduction.verdicts import Claim
from ethbrake_marl.files.sheet import Sheet
from ethbrake_marl.progress import OnProgress

PAPER_EPISODES = 10_000

DRIVERS = "PPO and SAC are the shipped policies, trained on paper-random at 0.5 and 0.8 s; they are not the paper's."


@dataclass(frozen=True)
class ReproductionSettings:
    folder: Path  # for all results
    episodes: int = PAPER_EPISODES  # largest number of worlds of an item
    tell: OnProgress = lambda progress: None


class DrawnFigure(NamedTuple):
    stem: str  # name of the files without their endings
    title: str
    text: str  # description
    figure: Figure


class Made(NamedTuple):
    claims: Sequence[Claim] = ()  # claims of the paper with our verdicts
    sheets: Sequence[Sheet] = ()  # tables
    figures: Sequence[DrawnFigure] = ()
    notes: Sequence[str] = ()  # what was run


class Item(NamedTuple):
    name: str  # on the command line, and of the folder
    labels: tuple[str, ...]  # in the paper's source
    title: str
    what: str
    make: Callable[[ReproductionSettings], Made]
    most_s: float  # processor time with as many worlds as in the paper
