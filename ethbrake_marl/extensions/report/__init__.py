"""HTML reports of evaluations and runs, and figures."""

from typing import TYPE_CHECKING

from ethbrake_marl.lazy_imports import front_door

if TYPE_CHECKING:
    from ethbrake_marl.extensions.report.figures import (
        deceleration_figure as deceleration_figure,
        harm_against_total_gap as harm_against_total_gap,
        trajectories as trajectories,
    )
    from ethbrake_marl.extensions.report.style import write_picture as write_picture

else:
    __getattr__ = front_door(__name__)
