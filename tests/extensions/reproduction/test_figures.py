"""Figures show what they are given."""

import numpy as np
import pytest

from ethbrake_marl.extensions.reproduction.figures import VEHICLE_2, estimates_figure, profiles_figure, road_figure
from ethbrake_marl.extensions.reproduction.readings import PPO, STATED
from ethbrake_marl.extensions.reproduction.trajectories import record_all
from ethbrake_marl.files.sheet import Estimate

LINES = {"one": {10.0: Estimate(1.0, (0.5, 2.0)), 20.0: Estimate(3.0, (2.5, 4.0))}}


def test_estimates__over_numbers_are_lines_with_bands() -> None:
    (axes,) = estimates_figure({"p": LINES}, "y", "c", "x").axes
    (line,), (band,) = axes.lines, axes.collections
    assert line.get_xydata().tolist() == [[10.0, 1.0], [20.0, 3.0]]
    corners = band.get_paths()[0].vertices
    assert {tuple(each) for each in corners.tolist()} == {(10.0, 0.5), (10.0, 2.0), (20.0, 2.5), (20.0, 4.0)}


def test_estimates__over_texts_are_bars_with_intervals() -> None:
    bars = {"one": {"low": Estimate(1.0, (0.5, 2.0))}, "other": {"low": Estimate(3.0, None)}}
    (axes,) = estimates_figure({"p": bars}, "y", "c").axes
    assert [patch.get_height() for patch in axes.patches] == [1.0, 3.0]
    ends = [each.get_segments()[0][:, 1].tolist() for each in axes.collections]
    assert ends == [[0.5, 2.0], [3.0, 3.0]] and [text.get_text() for text in axes.get_xticklabels()] == ["low"]


def test_road__has_an_arrow_every_second_on_the_row_of_its_vehicle() -> None:
    record = record_all()[STATED, 1, PPO]
    axes, _ = road_figure({"PPO": record, "again": record}, "c").axes
    arrows = [line for line in axes.lines if line.get_marker() == ">"]
    for i, line in enumerate(arrows):
        assert len(line.get_xdata()) == int(record.time_s[-1]) + 1 and set(line.get_ydata()) == {i + 1}
        at = np.interp(np.arange(int(record.time_s[-1]) + 1), record.time_s, record.positions_m[:, i])
        assert line.get_xdata() == pytest.approx(at)


def test_profiles__show_the_command_of_vehicle_2() -> None:
    record = record_all()[STATED, 1, PPO]
    axes, _ = profiles_figure({"PPO": {"stated": record}, "again": {"stated": record}}, "c").axes
    assert np.array_equal(axes.lines[1].get_ydata(), record.command_mps2[:, VEHICLE_2])
