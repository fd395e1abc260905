"""HTML pages, figures and films."""

from ethbrake_marl.extensions.report.deceleration_curve import deceleration_curve as deceleration_curve
from ethbrake_marl.extensions.report.deceleration_figure import deceleration_figure as deceleration_figure
from ethbrake_marl.extensions.report.run_figures import harm_against_total_gap as harm_against_total_gap
from ethbrake_marl.extensions.report.style import write_picture as write_picture
from ethbrake_marl.extensions.report.trajectories import trajectories as trajectories
