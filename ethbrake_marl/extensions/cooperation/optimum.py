"""Joint optimum of a level: in each world, the least harm known that its learners can do together.

It depends on worlds, learners and scripts, but not on what the learners know or minimise, so levels that differ only in
that share one search. Best commands of one level count for every other level whose learners can give the same ones.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from ethbrake_marl.episode.game import Game
from ethbrake_marl.episode.state import FIRST_DECISION, State
from ethbrake_marl.extensions.cooperation.levels import Level, Plan
from ethbrake_marl.extensions.search.pricing import Problem, Profiles, problem_of
from ethbrake_marl.motion.layout import FAR_M, GAP, Bools, Floats
from ethbrake_marl.names import open_game
from ethbrake_marl.progress import OnProgress, Progress
from ethbrake_marl.worlds.sampling import Drawn

if TYPE_CHECKING:
    from ethbrake_marl.extensions.cooperation.measured import Measured
