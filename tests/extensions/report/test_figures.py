"""Figures, drawn from the very numbers."""

from typing import Any

import matplotlib
import numpy as np
import pytest
from matplotlib.figure import Figure

import ethbrake_marl as eb
from ethbrake_marl.evaluation.comparison import Comparison
from ethbrake_marl.evaluation.statistics import mean
from ethbrake_marl.extensions.report.figures import (
    BINS,
    curve_over_seeds,
    curves_figure,
    deceleration_figure,
    harm_above,
    harm_against_total_gap,
    harm_by_agent,
    trajectories,
    worlds_figure,
)
from ethbrake_marl.extensions.report.style import label_text, new_figure, picture_bytes, series_style
from ethbrake_marl.files.sheet import Estimate
from tests.evaluation.lines import recorded
from tests.extensions.report.conftest import compared_by


def caption(figure: Figure) -> str:
    return figure.get_supxlabel().replace("\n", " ").replace("\u00a0", " ")


def legend(figure: Figure) -> list[str]:
    return [text.get_text() for each in figure.legends for text in each.get_texts()]


def record_of(world: int, agent: str, scenario: str = "paper-random") -> eb.EpisodeRecord:
    return eb.record_episode(scenario, agent, number=world)


# ---- all figures


def test_figure__is_the_same_under_any_style_of_the_user() -> None:
    def drawn() -> bytes:
        return picture_bytes(curves_figure({"a": {"b": {1: Estimate(2.0, None)}}}, "x", "c"), "a.png")

    ours = drawn()
    for style in ({"text.color": "red", "font.size": 20}, {"axes.facecolor": "black", "savefig.facecolor": "black"}):
        with matplotlib.rc_context(style):
            assert drawn() == ours


def test_series__differ_in_grey() -> None:
    looks = [series_style(number) for number in range(7)]
    assert len({look["marker"] for look in looks}) == 7 and series_style(7) == looks[0]
    assert len({look["linestyle"] for look in looks[:5]}) == 5


@pytest.mark.parametrize("text", ["$x^2$", "测试🚗"])
def test_label__of_anybody_can_be_drawn(text: str) -> None:
    figure = new_figure(3.0, 2.0)
    figure.subplots().set_xlabel(label_text(text))
    svg = picture_bytes(figure, "a.svg")
    assert b"<script" not in svg and len(svg) < 200_000
    assert figure._repr_png_().startswith(b"\x89PNG\r\n\x1a\n")
    assert label_text("$x^2$ is no formula") == r"\$x^2\$ is no formula"


# ---- of a scenario


def test_worlds_figure__shows_every_quantity_that_varies_and_three_worlds() -> None:
    scenario = eb.load_scenario("paper-random-obstacle").replace(mass_t=[4.0, {"uniform": [1.0, 2.0]}, 5.0])
    drawn = scenario.draw(50, 7)
    figure = worlds_figure(scenario, drawn, seed=7)
    *shares, road = figure.axes
    assert [axes.get_xlabel() for axes in shares] == ["gaps (m)", "speeds (m/s)", "mass (t)", "obstacle gap (m)"]
    assert [text.get_text() for text in shares[1].get_legend().get_texts()] == ["vehicle 3", "vehicle 2", "vehicle 1"]
    edges = shares[2].patches[0].get_xy()  # an outline of Vehicle 2's mass alone
    counts, _ = np.histogram(drawn.worlds.mass_t[:, 1], 24)
    assert shares[2].get_legend() is None and edges[1:-1:2, 1] == pytest.approx(counts / 50)
    assert road.images[0].get_array().shape == (3 * 224, 800, 3)
    assert caption(figure) == "paper-random-obstacle, 50 worlds of the list of seed 7; shares of worlds."


# ---- of an evaluation


def test_harm_by_agent__bars_line_and_marks_are_the_means(searched: Comparison) -> None:
    other = compared_by("paper-random-obstacle", "coast,ppo,full_brake", 20)
    figure = harm_by_agent(searched, {"Other test": other})
    (axes,) = figure.axes
    harms = [searched.result[agent]["first_impact_harm"] for agent in searched.teams]
    assert [bar.get_width() for bar in axes.patches] == pytest.approx([harm.mean() for harm in harms])
    ends = [each.get_segments()[0][:, 0] for each in axes.collections]
    assert np.array(ends) == pytest.approx(np.array([mean(harm).ends for harm in harms]))
    best, marks = axes.lines
    assert best.get_xdata()[0] == pytest.approx(searched.result["ppo"]["best_known_first"].mean())
    braking, learned = (other.result[agent]["first_impact_harm"].mean() for agent in ("full_brake", "ppo"))
    assert marks.get_xydata() == pytest.approx(np.array([[braking, 0.0], [learned, 2.0]]))
    assert legend(figure) == ["best known", "other test"]


def test_harm_above__shares_are_those_of_the_worlds(compared: Comparison, searched: Comparison) -> None:
    for one, label in ((compared, "Harm"), (searched, "Regret")):
        axes = harm_above(one).axes[0]
        drawn, values = axes.lines[0], one.result["full_brake"]["first_impact_harm"]
        if label == "Regret":
            values = values - one.result["full_brake"]["best_known_first"]
        assert drawn.get_ydata() == pytest.approx([np.mean(values > x) for x in drawn.get_xdata()])
        assert axes.get_xlabel().startswith(label)


def test_harm_against_total_gap__means_and_bands_are_those_of_the_groups(compared: Comparison) -> None:
    figure = harm_against_total_gap(compared.result)
    first, total = figure.axes
    gap = compared.result.worlds["gap_1_m"] + compared.result.worlds["gap_2_m"]
    ends = np.linspace(gap.min(), gap.max(), BINS + 1)
    rows = gap >= ends[-2]
    harm, worse = compared.result["full_brake"]["first_impact_harm"], compared.result["ppo"]["total_harm"]
    place = int(np.flatnonzero(np.isclose(first.lines[0].get_xdata(), gap[rows].mean()))[0])
    assert first.lines[0].get_ydata()[place] == pytest.approx(harm[rows].mean())
    assert total.lines[2].get_ydata()[place] == pytest.approx(worse[rows].mean())
    assert legend(figure) == [*compared.teams] and "seed 7" in caption(figure)
    assert first.get_xlabel() == "Total gap at the alert, d1 + d2 (m)" and first.get_ylim()[0] == 0.0
    one = harm_against_total_gap(compared.result.take([0])).axes[0].lines[0]
    assert one.get_xydata() == pytest.approx(np.array([[gap[0], harm[0]]]))
    honest = compared_by("paper-random", "full_brake,coast", 1, "honest").result
    *_, cost = harm_against_total_gap(honest).axes
    assert cost.get_title(loc="left") == "Honest cost (m²/s²)"
    assert cost.lines[1].get_ydata() == pytest.approx(honest["coast"]["honest_cost"])


def test_intervals__are_by_recording_wherever_worlds_come_from_recordings() -> None:
    recordings = compared_by(recorded(8), "full_brake,constant:4.5")
    result, by = recordings.result, recordings.result.clusters
    gap = result.worlds["gap_1_m"] + result.worlds["gap_2_m"]
    group = gap >= np.linspace(gap.min(), gap.max(), BINS + 1)[-2]
    for agent, own in enumerate(result.columns.values()):
        bars = harm_by_agent(recordings, {}).axes[0].collections[agent].get_segments()[0][:, 0]
        assert bars == pytest.approx(mean(own["first_impact_harm"], by).ends)
        assert np.ptp(bars) > 1.3 * np.ptp(mean(own["first_impact_harm"]).ends)  # worlds of a recording are alike
        for axes, harm in zip(harm_against_total_gap(result).axes, ("first_impact_harm", "total_harm"), strict=True):
            corners = axes.collections[agent].get_paths()[0].vertices
            ends = corners[np.isclose(corners[:, 0], gap[group].mean()), 1]
            expected = mean(own[harm][group], by[group]).ends
            assert (ends.min(), ends.max()) == pytest.approx(expected)
            assert expected != mean(own[harm][group]).ends


def test_curves__are_means_with_bands_and_lines() -> None:
    curve = curve_over_seeds([{0: 4.0, 10: 1.0, 15: 9.0}, {0: 8.0, 10: 3.0}])  # at the steps that all have
    assert curve_over_seeds([{5: 2.0}]) == {5.0: Estimate(2.0, (2.0, 2.0))}
    panels = {"harm": {"ppo": curve}, "return": {"ppo": {1: Estimate(-1.0, None)}}}
    figure = curves_figure(panels, "x", "c", lines={"harm": {"best known": 0.5}})
    left, right = figure.axes
    assert left.lines[0].get_xydata().tolist() == [[0.0, 6.0], [10.0, 2.0]]
    corners = left.collections[0].get_paths()[0].vertices[:, 1]
    assert (corners.min(), corners.max()) == pytest.approx((2.0 - 2.0**0.5, 6.0 + 8.0**0.5))
    assert legend(figure) == ["ppo", "best known"] and left.lines[1].get_ydata()[0] == 0.5
    assert left.get_ylim()[0] == 0.0 and right.get_ylim()[0] < -1.0


# ---- of an episode


def test_trajectories__lines_and_impacts_are_those_of_the_record() -> None:
    record = record_of(0, "ppo")
    figure = trajectories("paper-random", {"PPO": "ppo"})
    above, gaps, commands = figure.axes
    for i in range(3):
        assert above.lines[i].get_ydata().tolist() == record.positions_m[:, i].tolist()
    assert [line.get_ydata().tolist() for line in gaps.lines[:2]] == record.gaps_m.T.tolist()
    assert commands.lines[1].get_ydata().tolist() == record.command_mps2[:, 1].tolist()
    assert commands.lines[2].get_xdata()[0] == 0.5 and commands.texts[0].get_text() == "acts from 0.5 s"
    first = record.impacts.first_impact_harm > 0.0
    assert [len(each.get_offsets()) for each in above.collections] == [first.sum(), (~first).sum()] == [1, 1]
    rows = zip(record.impacts.time_s[first], record.impacts.pair[first], strict=True)
    places = [(t, np.interp(t, record.time_s, record.positions_m[:, pair - 1])) for t, pair in rows]
    assert np.asarray(above.collections[0].get_offsets()) == pytest.approx(np.array(places))
    words = [text.get_text() for text in above.texts]
    assert words == [f"{speed:.1f}" for speed in record.impacts.closing_speed_mps[first]]
    assert above.get_title(loc="left") == "PPO\nharm 5.60 first-impact, 5.84 total"
    rest = record.time_s[np.flatnonzero(record.speeds_mps.any(axis=1))[-1] + 1]
    assert above.get_xlim() == pytest.approx((0.0, 1.1 * rest))
    assert caption(figure).startswith("paper-random: d = (6.62, 8.488) m; ")


def test_trajectories__of_a_team_show_the_commands_of_each_learner_and_the_obstacle() -> None:
    record = record_of(0, "full_brake", "cooperation-4-all")
    above, _, commands = trajectories("cooperation-4-all", "full_brake").axes
    assert commands.get_ylabel() == "Command of\nVehicles 1, 2, 3 (m/s²)"
    obstacle = next(line for line in above.lines if line.get_label() == "obstacle")
    assert obstacle.get_ydata()[0] == record.initial.obstacle_gap_m[0]


def test_deceleration_figure__marks_what_e_v2x_bm_predicts_and_does() -> None:
    """World 5 of seed 7: golden values of version 0.5."""
    scenario = eb.load_scenario("paper-random")
    figure = deceleration_figure(scenario.sample(1, 7, first=5), scenario, best_known={"first": 14.41, "total": 14.84})
    words = legend(figure)
    assert "a* = 4.898 m/s², closed form: 17.74 predicted, 55.74 simulated" in words
    assert "a* = 6.188 m/s², coupled, least first-impact harm: 33.40" in words
    assert "a* = 6.188 m/s², coupled, least total harm: 33.40" in words and "best known total harm: 14.84" in words
    lines, last = {line.get_label(): line for line in figure.axes[0].lines}, record_of(5, "constant:3.5").last
    for label, count in (("simulated first-impact harm", "first"), ("simulated total harm", "total")):
        k = int(np.argmin(np.abs(lines[label].get_xdata() - 3.5)))
        assert lines[label].get_ydata()[k] == pytest.approx(float(last.harm(count)[0]), abs=1e-9)


def worlds_of(name: str, n: int) -> eb.State:
    return eb.load_scenario(name).sample(n, 7)


@pytest.mark.parametrize(
    ("draw", "said"),
    [
        (lambda: picture_bytes(new_figure(1.0, 1.0), "a.jpg"), "must end in .png, .svg or .pdf"),
        (lambda: deceleration_figure(worlds_of("cooperation-3-pair", 1), "cooperation-3-pair"), "1 worlds, 2 learners"),
    ],
)
def test_figure__is_refused(draw: Any, said: str) -> None:
    with pytest.raises(eb.EthBrakeError, match=said):
        draw()
