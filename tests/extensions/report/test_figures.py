"""Figures, drawn from the very numbers."""

from typing import Any

import matplotlib
import numpy as np
import pytest
from matplotlib.collections import PathCollection
from matplotlib.figure import Figure

import ethbrake_marl as eb
from ethbrake_marl.evaluation.compared import Compared
from ethbrake_marl.evaluation.statistics import mean
from ethbrake_marl.extensions.rendering.scene import BODY_M
from ethbrake_marl.extensions.report.best_known import BestKnown
from ethbrake_marl.extensions.report.deceleration import deceleration_figure
from ethbrake_marl.extensions.report.episode_figure import trajectories
from ethbrake_marl.extensions.report.harm_figures import harm_above, harm_against_total_gap, harm_by_agent
from ethbrake_marl.extensions.report.scenario_figures import worlds_figure
from ethbrake_marl.extensions.report.seed_curves import SeedCurve, learning_curve, seed_curves
from ethbrake_marl.extensions.report.style import label_text, new_figure, picture_bytes
from ethbrake_marl.names import teams_of

POINTS = [
    {"steps": 0.0, "first_impact_harm": 30.0, "total_harm": 33.0, "collision_rate": 1.0},
    {"steps": 50_000.0, "first_impact_harm": 12.0, "total_harm": 15.0, "collision_rate": 0.8},
]


def caption(figure: Figure) -> str:
    return figure.get_supxlabel().replace("\n", " ").replace("\u00a0", " ")


def legend(figure: Figure) -> list[str]:
    return [text.get_text() for each in figure.legends for text in each.get_texts()]


def record_of(world: int, agent: str, scenario: str = "paper-random") -> eb.EpisodeRecord:
    loaded, game = eb.open_game(scenario)
    (team,) = teams_of(agent, loaded).values()
    return eb.record_episode(loaded.sample(1, 7, first=world), team, game)


# ---- all figures


@pytest.mark.parametrize(
    "style", [{"text.color": "red", "font.size": 20}, {"axes.facecolor": "black", "axes.grid": True}]
)
def test_figure__is_the_same_under_any_style_of_the_user(style: dict[str, object], compared: Compared) -> None:
    def drawn() -> bytes:
        return picture_bytes(harm_by_agent(compared.table), "a.png")

    ours = drawn()
    with matplotlib.rc_context(style):
        assert drawn() == ours


@pytest.mark.parametrize("text", ["$x^2$", "a_b$", "\u202eabc", "测试🚗", "x" * 500, "</text><script>"])
def test_label__of_anybody_can_be_drawn(text: str) -> None:
    figure = new_figure(3.0, 2.0)
    figure.subplots().set_xlabel(label_text(text))
    svg = picture_bytes(figure, "a.svg")
    assert b"<script" not in svg and len(svg) < 200_000
    assert figure._repr_png_().startswith(b"\x89PNG\r\n\x1a\n")


# ---- of a scenario


def test_worlds_figure__shows_every_quantity_that_varies_and_lines_to_scale() -> None:
    scenario = eb.load_scenario("paper-random-obstacle")
    drawn = scenario.draw(50, 7)
    figure = worlds_figure(scenario, drawn, seed=7)
    shares, pairs, lines = ([*part.axes] for part in figure.subfigs)
    assert [axes.get_xlabel() for axes in shares] == ["gaps (m)", "speeds (m/s)", "obstacle gap (m)"]
    for axes in shares:
        heights = [end for patch in axes.patches for end in np.unique(patch.get_xy()[:, 1])]
        assert max(heights) < 1.0 and min(heights) == 0.0
    at = {(axes.get_subplotspec().rowspan.start, axes.get_subplotspec().colspan.start): axes for axes in pairs}
    points = np.asarray(at[3, 2].collections[0].get_offsets())
    worlds = drawn.worlds
    assert points == pytest.approx(np.column_stack([worlds.speeds_mps[:, 0], worlds.obstacle_gap_m]))
    total = worlds.gaps_m.sum(axis=1)
    for axes, row in zip(lines, (total.argmin(), None, total.argmax()), strict=True):
        if row is not None:
            left = [patch.get_x() for patch in axes.patches]
            assert axes.get_title(loc="left").startswith(f"World {row}, ") and left[0] == -BODY_M
            assert np.diff(left) == pytest.approx(-(worlds.gaps_m[row] + BODY_M))
    assert "50 worlds of the list of seed 7" in caption(figure)


def test_worlds_figure__tells_vehicles_with_other_bounds_apart() -> None:
    scenario = eb.load_scenario("paper-random").replace(mass_t=[4.0, {"uniform": [1.0, 2.0]}, {"uniform": [5.0, 9.0]}])
    figure = worlds_figure(scenario, scenario.draw(20, 7), seed=7)
    masses = next(axes for axes in figure.subfigs[0].axes if axes.get_xlabel() == "mass (t)")
    assert [text.get_text() for text in masses.get_legend().get_texts()] == ["Vehicle 2", "Vehicle 3"]


# ---- of an evaluation


def test_harm_by_agent__bars_line_and_marks_are_the_means(searched: Compared) -> None:
    figure = harm_by_agent(searched.table, "total", BestKnown.of(searched.result), {"Other test": searched.table})
    (axes,) = figure.axes
    means = [searched.result[agent]["total_harm"].mean() for agent in searched.teams]
    assert [bar.get_width() for bar in axes.patches] == pytest.approx(means)
    best, marks = axes.lines
    assert best.get_xdata()[0] == pytest.approx(searched.result["ppo"]["best_known_total"].mean())
    assert marks.get_xdata() == pytest.approx(means) and legend(figure) == ["best known", "other test"]


def test_harm_above__shares_are_those_of_the_worlds(compared: Compared, searched: Compared) -> None:
    for one, label in ((compared, "Harm"), (searched, "Regret")):
        axes = harm_above(one.result).axes[0]
        drawn, values = axes.lines[0], one.result["full_brake"]["first_impact_harm"]
        if label == "Regret":
            values = values - one.result["full_brake"]["best_known_first"]
        assert drawn.get_ydata() == pytest.approx([np.mean(values > x) for x in drawn.get_xdata()])
        assert axes.get_xlabel().startswith(label)


def test_harm_against_total_gap__means_and_bands_are_those_of_the_groups(compared: Compared) -> None:
    figure = harm_against_total_gap(compared.result, bins=2)
    first, total = figure.axes
    gap = compared.result.worlds["gap_1_m"] + compared.result.worlds["gap_2_m"]
    near = gap < 0.5 * (gap.min() + gap.max())
    harm, worse = compared.result["full_brake"]["first_impact_harm"], compared.result["ppo"]["total_harm"]
    assert first.lines[0].get_xdata() == pytest.approx([gap[near].mean(), gap[~near].mean()])
    assert first.lines[0].get_ydata() == pytest.approx([harm[near].mean(), harm[~near].mean()])
    assert total.lines[2].get_ydata() == pytest.approx([worse[near].mean(), worse[~near].mean()])
    band = first.collections[0].get_paths()[0].vertices[:, 1]
    low, high = zip(*(mean(harm[g]).interval for g in (near, ~near)), strict=True)
    assert (band.min(), band.max()) == (pytest.approx(min(low)), pytest.approx(max(high)))
    assert legend(figure) == [*compared.teams] and "seed 7" in caption(figure)
    assert first.get_xlabel() == "Total gap at the alert, d1 + d2 (m)"
    one = harm_against_total_gap(compared.result.take([0])).axes[0].lines[0]
    assert one.get_xydata() == pytest.approx(np.array([[gap[0], harm[0]]]))


# ---- of trainings


def test_learning_curve__has_the_points_and_the_references(compared: Compared) -> None:
    figure = learning_curve(POINTS, learned="mine", references=compared.table[:2], caption="x")
    for axes, name in zip(figure.axes, ("first_impact_harm", "total_harm", "collision_rate"), strict=True):
        assert axes.lines[0].get_ydata().tolist() == [point[name] for point in POINTS]
        assert axes.lines[1].get_ydata()[0] == compared.table[0][name].value
    assert legend(figure) == ["mine", "full_brake", "constant:4.5"]


def test_seed_curves__draw_means_and_bands_of_one_standard_deviation() -> None:
    curve = SeedCurve.of([{0: 4.0, 10: 1.0, 15: 9.0}, {0: 8.0, 10: 3.0}])  # the steps that all have
    assert (curve.steps.tolist(), curve.values.tolist()) == ([0.0, 10.0], [[4.0, 1.0], [8.0, 3.0]])
    figure = seed_curves({"harm": {"ppo": curve}, "return": {"ppo": curve}}, logarithmic=["harm"], caption="x")
    left, right = figure.axes
    assert (left.get_yscale(), right.get_yscale(), legend(figure)) == ("log", "linear", ["ppo, 2 seeds"])
    assert left.lines[0].get_ydata().tolist() == [6.0, 2.0]
    band = left.collections[0].get_paths()[0].vertices[:, 1]
    assert (band.min(), band.max()) == pytest.approx((2.0 - 2.0**0.5, 6.0 + 8.0**0.5))
    single = SeedCurve(np.array([0.0, 1.0]), np.array([[5.0, 0.0]]))  # zero has no logarithm
    figure = seed_curves({"harm": {"sac": single}}, logarithmic=["harm"], known={"harm": 0.5})
    assert (figure.axes[0].get_yscale(), legend(figure)) == ("linear", ["sac, 1 seed", "best known"])


# ---- of an episode


def test_trajectories__lines_and_impacts_are_those_of_the_record() -> None:
    record = record_of(0, "full_brake")
    figure = trajectories({"Full braking": record})
    above, gaps, commands = figure.axes
    for i in range(3):
        assert above.lines[i].get_ydata().tolist() == record.positions_m[:, i].tolist()
    assert [line.get_ydata().tolist() for line in gaps.lines[:2]] == record.gaps_m.T.tolist()
    assert commands.lines[1].get_ydata().tolist() == record.command_mps2[:, 1].tolist()
    crosses = [each for each in above.collections if isinstance(each, PathCollection)]
    first = record.impacts.first_impact_harm > 0.0
    assert [len(each.get_offsets()) for each in crosses] == [first.sum(), (~first).sum()]
    assert crosses[0].get_offsets()[:, 0].tolist() == record.impacts.time_s[first].tolist()
    rows = zip(record.impacts.time_s[first], record.impacts.pair[first], strict=True)
    front = [np.interp(t, record.time_s, record.positions_m[:, pair - 1]) for t, pair in rows]
    assert np.asarray(crosses[0].get_offsets())[:, 1].tolist() == pytest.approx(front)
    words = [text.get_text() for text in above.texts]
    assert words == [f"{speed:.1f}" for speed in record.impacts.closing_speed_mps[first]]
    assert above.get_title(loc="left") == "Full braking\nharm 33.79 first-impact, 33.79 total"
    assert caption(figure).startswith("paper-random: d = (6.62, 8.488) m; ")


def test_trajectories__of_a_team_show_the_commands_of_each_learner_and_the_obstacle() -> None:
    record = record_of(0, "full_brake", "cooperation-4-all")
    above, _, commands = trajectories({"a": record}).axes
    assert commands.get_ylabel() == "Command of\nVehicles 1, 2, 3 (m/s²)"
    obstacle = next(line for line in above.lines if line.get_label() == "obstacle")
    assert obstacle.get_ydata()[0] == record.initial.obstacle_gap_m[0]


def test_deceleration_figure__marks_what_e_v2x_bm_predicts_and_does() -> None:
    """World 5 of seed 7: golden values of version 0.5."""
    scenario = eb.load_scenario("paper-random")
    figure = deceleration_figure(scenario.sample(1, 7, first=5), scenario, known={"first": 14.41, "total": 14.84})
    words = legend(figure)
    assert "a* = 4.898 m/s², closed form: 17.74 predicted, 55.74 simulated" in words
    assert "a* = 6.188 m/s², coupled, least first-impact harm: 33.40" in words
    assert "a* = 6.188 m/s², coupled, least total harm: 33.40" in words and "best known total harm: 14.84" in words
    (axes,) = figure.axes
    for line, agent in ((axes.lines[1], "constant:3.5"), (axes.lines[2], "constant:3.5")):
        k = int(np.argmin(np.abs(line.get_xdata() - 3.5)))
        count = "first" if line.get_label() == "simulated first-impact harm" else "total"
        assert line.get_ydata()[k] == pytest.approx(float(record_of(5, agent).last.harm(count)[0]), abs=1e-9)


@pytest.mark.parametrize(
    ("draw", "said"),
    [
        (lambda: trajectories({}), "there are no records; give at least one"),
        (lambda: SeedCurve.of([{1: 2.0}, {3: 4.0}]), "no evaluated step in common"),
        (lambda: picture_bytes(new_figure(1.0, 1.0), "a.jpg"), "must end in .png, .svg or .pdf"),
        (
            lambda: deceleration_figure(eb.load_scenario("paper-random").sample(2, 7), "paper-random"),
            "2 worlds, 1 learners, 0 scripts",
        ),
        (
            lambda: deceleration_figure(eb.load_scenario("cooperation-3-pair").sample(1, 7), "cooperation-3-pair"),
            "1 worlds, 2 learners",
        ),
        (
            lambda: deceleration_figure(eb.load_scenario("paper-random").sample(1, 7), "paper-random", points=1),
            "points = 1",
        ),
    ],
)
def test_figure__is_refused(draw: Any, said: str) -> None:
    with pytest.raises(eb.EthBrakeError, match=said):
        draw()


def test_harm_against_total_gap__needs_a_bin(compared: Compared) -> None:
    with pytest.raises(eb.EthBrakeError, match="bins = 0: the number of bins must be at least 1"):
        harm_against_total_gap(compared.result, bins=0)
