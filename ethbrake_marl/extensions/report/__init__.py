"""HTML reports of evaluations and runs, and figures."""

from typing import TYPE_CHECKING

from ethbrake_marl.doors import front_door

if TYPE_CHECKING:
    from ethbrake_marl.extensions.report.deceleration import deceleration_figure as deceleration_figure
    from ethbrake_marl.extensions.report.episode_figure import trajectories as trajectories
    from ethbrake_marl.extensions.report.harm_figures import harm_against_total_gap as harm_against_total_gap
    from ethbrake_marl.extensions.report.style import write_picture as write_picture

else:
    __getattr__ = front_door(__name__, __file__)
