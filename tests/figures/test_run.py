from __future__ import annotations

import numpy as np
import pytest
from matplotlib.collections import PathCollection
from matplotlib.figure import Figure

from ethbrake_marl.agents.registry import make_agent
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.evaluation import EpisodeRecord, Evaluation, evaluate, record_episode, summarise
from ethbrake_marl.evaluation.statistics import mean
from ethbrake_marl.figures import (
    COLOURS,
    ShownFigure,
    harm_against_total_gap,
    learning_curve,
    picture_bytes,
    series_style,
    trajectories,
)
from ethbrake_marl.scenario import Scenario

POINTS = [
    {"steps": 0.0, "first_impact_harm": 30.0, "total_harm": 33.0, "collision_rate": 1.0},
    {"steps": 50_000.0, "first_impact_harm": 12.0, "total_harm": 15.0, "collision_rate": 0.8},
]


@pytest.fixture
def record(evaluation: Evaluation) -> EpisodeRecord:
    k = int(np.argmax(evaluation.outcome("full_brake").impacts))
    return record_episode(evaluation.worlds.take([k]), make_agent("full_brake"), scenario=evaluation.scenario)


def caption(figure: Figure) -> str:
    return figure.get_supxlabel().replace("\n", " ").replace("\u00a0", " ")


def legend(figure: Figure) -> list[str]:
    return [text.get_text() for text in figure.legends[0].get_texts()]


def test_learning_curve__shows_the_points_and_the_references(evaluation: Evaluation) -> None:
    rows = summarise(evaluation)[:2]
    figure = learning_curve(POINTS, references=rows, caption="1,000 worlds, seed 3")
    first, total, rate = figure.axes
    assert first.lines[0].get_xydata().tolist() == [[0.0, 30.0], [50_000.0, 12.0]]
    assert total.lines[0].get_ydata().tolist() == [33.0, 15.0]
    assert rate.lines[0].get_ydata().tolist() == [1.0, 0.8]
    assert first.lines[2].get_ydata()[0] == rows[1].first_impact_harm.value
    assert rate.lines[1].get_ydata()[0] == rows[0].collision_rate.value
    assert legend(figure) == ["policy", "full_brake", "constant:4.5"]
    assert all("m²/s²" in axes.get_title(loc="left") for axes in (first, total))
    assert caption(figure) == "1,000 worlds, seed 3"


def test_learning_curve__no_reference_looks_like_the_policy(evaluation: Evaluation) -> None:
    rows = summarise(evaluation)
    figure = learning_curve(POINTS, references=[*rows, *rows])
    policy, *references = figure.axes[0].lines
    assert policy.get_color() not in {line.get_color() for line in references}


@pytest.mark.parametrize("name", ["a.png", "a.svg", "a.pdf"])
def test_picture_bytes__laid_out_without_being_drawn_is_what_matplotlib_makes(name, evaluation, monkeypatch) -> None:
    ours = picture_bytes(learning_curve(POINTS, references=summarise(evaluation), caption="seed 3"), name)
    monkeypatch.setattr(ShownFigure, "draw", Figure.draw)
    assert ours == picture_bytes(learning_curve(POINTS, references=summarise(evaluation), caption="seed 3"), name)


def test_learning_curve__without_points_is_refused() -> None:
    with pytest.raises(InvalidInput, match="no points"):
        learning_curve([])


def test_harm_against_total_gap__means_and_bands_are_those_of_the_groups(evaluation: Evaluation) -> None:
    figure = harm_against_total_gap(evaluation, bins=2)
    first, total = figure.axes
    gap = evaluation.worlds.gaps_m.sum(axis=1)
    near = gap < 0.5 * (gap.min() + gap.max())
    harm = evaluation.outcome("full_brake").first_impact_harm
    assert first.lines[0].get_xdata() == pytest.approx([gap[near].mean(), gap[~near].mean()])
    assert first.lines[0].get_ydata() == pytest.approx([harm[near].mean(), harm[~near].mean()])
    band = first.collections[0].get_paths()[0].vertices
    assert band[:, 1].min() == pytest.approx(min(mean(harm[g]).interval[0] for g in (near, ~near)))
    assert band[:, 1].max() == pytest.approx(max(mean(harm[g]).interval[1] for g in (near, ~near)))
    worse = evaluation.outcome("gap").total_harm
    assert total.lines[2].get_ydata() == pytest.approx([worse[near].mean(), worse[~near].mean()])
    assert legend(figure) == ["full_brake", "constant:4.5", "gap"]
    assert first.get_xlabel() == "Total gap at the alert, d1 + d2 (m)"
    assert "seed 7" in caption(figure)


def test_harm_against_total_gap__worlds_with_one_and_the_same_gap_are_one_point(pair: Scenario) -> None:
    result = evaluate(pair.sample(5, 0), {"full_brake": make_agent("full_brake")}, scenario=pair)
    line = harm_against_total_gap(result).axes[0].lines[0]
    assert line.get_xydata() == pytest.approx(np.array([[1.0, 9.0]]))


def test_harm_against_total_gap__bad_input_is_refused(evaluation: Evaluation) -> None:
    with pytest.raises(InvalidInput, match="bins = 0"):
        harm_against_total_gap(evaluation, bins=0)
    with pytest.raises(InvalidInput, match="was not evaluated"):
        harm_against_total_gap(evaluation, agents=["ppo"])


def test_trajectories__lines_and_impacts_are_those_of_the_record(record: EpisodeRecord) -> None:
    figure = trajectories({"Full braking": record})
    above, gaps, command = figure.axes
    for i in range(3):
        assert above.lines[i].get_ydata().tolist() == record.positions_m[:, i].tolist()
    assert gaps.lines[1].get_ydata().tolist() == record.gaps_m[:, 1].tolist()
    assert (command.lines[1].get_ydata() == record.command_mps2[:, 1]).all()
    marks = {c.get_label(): c.get_offsets() for c in above.collections if isinstance(c, PathCollection)}
    assert marks["first impact"][:, 0].tolist() == record.impacts.time_s[record.impacts.first].tolist()
    assert len(marks["later impact"]) == np.count_nonzero(~record.impacts.first) > 0
    touching = np.interp(marks["first impact"][0, 0], record.time_s, record.positions_m[:, record.impacts.pair[0]])
    assert marks["first impact"][0, 1] == touching
    assert f"{record.ledger.world_harm('total')[0]:.2f} total" in above.get_title(loc="left")
    assert "Vehicle 2 (m/s²)" in command.get_ylabel()
    assert "paper-random: d = (" in caption(figure)


def test_trajectories__one_column_per_record_on_common_scales(record: EpisodeRecord) -> None:
    figure = trajectories({"one": record, "two": record}, caption="mine")
    assert len(figure.axes) == 6
    assert figure.axes[0].get_ylim() == figure.axes[1].get_ylim()
    assert caption(figure) == "mine"
    with pytest.raises(InvalidInput, match="no records"):
        trajectories({})


def test_png__is_a_picture_and_the_same_every_time(record: EpisodeRecord) -> None:
    one, other = (picture_bytes(trajectories({"x": record}), "figure.png") for _ in range(2))
    assert one.startswith(b"\x89PNG\r\n\x1a\n")
    assert one == other


def test_series_style__neighbours_differ_in_more_than_colour() -> None:
    for k in range(len(COLOURS) - 1):
        one, other = series_style(k), series_style(k + 1)
        assert one["color"] != other["color"]
        assert one["marker"] != other["marker"]
        assert one["linestyle"] != other["linestyle"]


def test_figure__a_notebook_shows_it_as_png(record: EpisodeRecord):
    figure = trajectories({"x": record})
    assert figure._repr_png_().startswith(b"\x89PNG")
