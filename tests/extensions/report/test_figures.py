"""Figures: the curves of a list and of a training, trajectories; drawn from the very numbers."""

import matplotlib
import numpy as np
import pytest
from matplotlib.collections import PathCollection
from matplotlib.figure import Figure

import ethbrake_marl.first_edition as eb
from ethbrake_marl.extensions.report import deceleration as module
from ethbrake_marl.extensions.report.deceleration import deceleration_curve, deceleration_figure
from ethbrake_marl.extensions.report.episode_figure import trajectories
from ethbrake_marl.extensions.report.harm_figures import harm_by_agent, harm_in_parts, regret_distribution
from ethbrake_marl.extensions.report.run_figures import harm_against_total_gap, learning_curve
from ethbrake_marl.extensions.report.scenario_figures import worlds_figure
from ethbrake_marl.extensions.report.seed_curves import SeedCurve, seed_curves
from ethbrake_marl.extensions.report.style import label_text, new_figure, picture_bytes
from ethbrake_marl.extensions.search.regret import regrets_of
from ethbrake_marl.first_edition.envs.rendering import BODY_M
from ethbrake_marl.first_edition.evaluation.evaluation import Evaluation
from ethbrake_marl.first_edition.evaluation.record import EpisodeRecord, record_episode
from ethbrake_marl.first_edition.evaluation.rollout import evaluate
from ethbrake_marl.first_edition.evaluation.statistics import mean
from ethbrake_marl.first_edition.evaluation.summary import summarise
from ethbrake_marl.first_edition.scenario.catalogue import load_scenario
from ethbrake_marl.first_edition.scenario.schema import Scenario
from ethbrake_marl.first_edition.scenario.tables import worlds_from_table
from ethbrake_marl.first_edition.scenario.task import Task
from tests.first_edition.physics.random_worlds import line

BRAKE = {"full_brake": eb.make_agent("full_brake")}
DISTANCE = load_scenario("paper-distance")
POINTS = [
    {"steps": 0.0, "first_impact_harm": 30.0, "total_harm": 33.0, "collision_rate": 1.0},
    {"steps": 50_000.0, "first_impact_harm": 12.0, "total_harm": 15.0, "collision_rate": 0.8},
]


def caption(figure: Figure) -> str:
    return figure.get_supxlabel().replace("\n", " ").replace("\u00a0", " ")


def legend(figure: Figure) -> list[str]:
    return [text.get_text() for each in figure.legends for text in each.get_texts()]


def world(gap_1: float, gap_2: float) -> eb.Worlds:
    """A world of paper-distance."""
    columns = {"gap_1_m": [gap_1], "gap_2_m": [gap_2], "speed_1_mps": [20.0], "speed_2_mps": [18.0]}
    return worlds_from_table(DISTANCE, {**columns, "speed_3_mps": [20.0]})


@pytest.fixture(scope="module")
def record(evaluation: Evaluation) -> EpisodeRecord:
    k = int(np.argmax(evaluation.outcome("full_brake").impacts))
    return record_episode(evaluation.worlds.take([k]), BRAKE["full_brake"], scenario=evaluation.scenario)


# ---------------------------------------------------------------- all figures


@pytest.fixture(scope="module")
def figures(evaluation: Evaluation, record: EpisodeRecord) -> dict[str, Figure]:
    rows = summarise(evaluation)
    return {
        "harm": harm_by_agent(rows),
        "regret": regret_distribution(evaluation),
        "parts": harm_in_parts(evaluation),
        "gap": harm_against_total_gap(evaluation),
        "learning": learning_curve(POINTS, references=rows),
        "episode": trajectories({"a": record}),
    }


@pytest.mark.parametrize(
    "style", [{"text.color": "red", "font.size": 20}, {"axes.facecolor": "black", "axes.grid": True}]
)
def test_figure__is_the_same_under_any_style_of_the_user(
    style: dict[str, object], evaluation: Evaluation, record: EpisodeRecord
) -> None:
    def drawn() -> list[bytes]:
        figures = trajectories({"a": record}), regret_distribution(evaluation), harm_by_agent(summarise(evaluation))
        return [picture_bytes(figure, "a.png") for figure in figures]

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


# ---------------------------------------------------------------- of a scenario


def test_worlds_figure__shows_every_quantity_that_varies_and_lines_to_scale() -> None:
    scenario = load_scenario("paper-random-obstacle")
    sample = scenario.sample(50, 7)
    figure = worlds_figure(scenario, sample, seed=7)
    shares, pairs, lines = ([*part.axes] for part in figure.subfigs)
    assert [axes.get_xlabel() for axes in shares] == ["gaps (m)", "speeds (m/s)", "obstacle gap (m)"]
    for axes in shares:
        heights = [end for patch in axes.patches for end in np.unique(patch.get_xy()[:, 1])]
        assert max(heights) < 1.0 and min(heights) == 0.0
    drawn = {(axes.get_subplotspec().rowspan.start, axes.get_subplotspec().colspan.start): axes for axes in pairs}
    points = np.asarray(drawn[3, 2].collections[0].get_offsets())
    assert points == pytest.approx(np.column_stack([sample.worlds.speeds_mps[:, 0], sample.worlds.obstacle_gap_m]))
    total = sample.worlds.gaps_m.sum(axis=1)
    for axes, row in zip(lines, (total.argmin(), None, total.argmax()), strict=True):
        if row is not None:
            left = [patch.get_x() for patch in axes.patches]
            assert axes.get_title(loc="left").startswith(f"World {row}, ") and left[0] == -BODY_M
            assert np.diff(left) == pytest.approx(-(sample.worlds.gaps_m[row] + BODY_M))
    assert "50 worlds of the list of seed 7" in caption(figure)


# ---------------------------------------------------------------- of a list


def test_harm_in_parts__add_up_to_the_means(evaluation: Evaluation, figures: dict[str, Figure]) -> None:
    for axes, field in zip(figures["parts"].axes, ("first_impact_harm", "total_harm"), strict=True):
        for k, outcome in enumerate(evaluation.outcomes.values()):
            bars = [bar for bar in axes.patches if round(bar.get_y() + bar.get_height() / 2) == k]
            assert sum(bar.get_width() for bar in bars) == pytest.approx(getattr(outcome, field).mean())


def test_regret_distribution__shares_are_those_of_the_worlds(evaluation: Evaluation, pair: Scenario) -> None:
    drawn = regret_distribution(evaluation).axes[0].lines[0]
    values = regrets_of(evaluation).regret(evaluation.outcome("full_brake"), "first")
    assert drawn.get_ydata() == pytest.approx([np.mean(values > x) for x in drawn.get_xdata()])
    assert regret_distribution(evaluate(pair.sample(3, 0), BRAKE, scenario=pair)).axes  # without limits


def test_harm_against_total_gap__means_and_bands_are_those_of_the_groups(
    evaluation: Evaluation, pair: Scenario
) -> None:
    figure = harm_against_total_gap(evaluation, bins=2)
    first, total = figure.axes
    gap = evaluation.worlds.gaps_m.sum(axis=1)
    near = gap < 0.5 * (gap.min() + gap.max())
    harm, worse = evaluation.outcome("full_brake").first_impact_harm, evaluation.outcome("gap").total_harm
    assert first.lines[0].get_xdata() == pytest.approx([gap[near].mean(), gap[~near].mean()])
    assert first.lines[0].get_ydata() == pytest.approx([harm[near].mean(), harm[~near].mean()])
    assert total.lines[2].get_ydata() == pytest.approx([worse[near].mean(), worse[~near].mean()])
    band = first.collections[0].get_paths()[0].vertices[:, 1]
    low, high = zip(*(mean(harm[g]).interval for g in (near, ~near)), strict=True)
    assert (band.min(), band.max()) == (pytest.approx(min(low)), pytest.approx(max(high)))
    assert legend(figure) == ["full_brake", "constant:4.5", "gap"] and "seed 7" in caption(figure)
    assert first.get_xlabel() == "Total gap at the alert, d1 + d2 (m)"
    alike = evaluate(pair.sample(5, 0), BRAKE, scenario=pair)  # one and the same gap is one point
    assert harm_against_total_gap(alike).axes[0].lines[0].get_xydata() == pytest.approx(np.array([[1.0, 9.0]]))


# ---------------------------------------------------------------- of a training


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


# ---------------------------------------------------------------- of an episode


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
    assert "Vehicle 2 (m/s²)" in command.get_ylabel() and "paper-random: d = (" in caption(figure)
    two = trajectories({"one": record, "two": record}, caption="mine")
    assert len(two.axes) == 6 and two.axes[0].get_ylim() == two.axes[1].get_ylim() and caption(two) == "mine"


# ---------------------------------------------------------------- decelerations


def test_curve__its_values_are_the_closed_form_and_the_simulation() -> None:
    curve = deceleration_curve(world(7.0, 7.0), Task(DISTANCE, (1,)), points=11)
    at = curve.deceleration_mps2
    assert (curve.predicted.min(), at[np.argmin(curve.predicted)]) == pytest.approx((4.03447, 5.17021), abs=1e-5)
    for k in (3, 9):
        agent = {"x": eb.make_agent(f"constant:{float(at[k])!r}")}
        driven = evaluate(world(7.0, 7.0), agent, scenario=DISTANCE).outcome("x")
        assert curve.first_impact_harm[k] == pytest.approx(driven.first_impact_harm[0], rel=1e-9)
        assert curve.total_harm[k] == pytest.approx(driven.total_harm[0], rel=1e-9)
    assert (np.diff(at) > 0.0).all() and (at[0], at[-1]) == (0.0, 7.0)


def test_curve__the_others_follow_their_scripts(paper_random: Scenario) -> None:
    coasting = paper_random.replace(roles={"vehicle_1": "full_brake", "vehicle_2": "learner", "vehicle_3": "coast"})
    worlds = paper_random.sample(1, 7).worlds
    curve = deceleration_curve(worlds, Task(coasting, (1,)), points=5)
    driven = evaluate(worlds, BRAKE, scenario=coasting).outcome("full_brake")
    assert 100.0 < curve.total_harm[-1] == pytest.approx(driven.total_harm[0], rel=1e-9)  # Vehicle 3 at about 20 m/s
    assert "Vehicle 1 full_brake, Vehicle 3 coast" in deceleration_figure(curve).get_supxlabel().replace("\n", " ")


def test_curve_of_scenario_1__changes_its_regimes_at_the_known_decelerations() -> None:
    # The curve of Scenario 1 changes its regimes at the known decelerations 4.71845 and 5.01031 m/s2 (0.004 apart),
    # and full braking does a harm of 28.98, by hand.
    scenario = eb.load_scenario("paper-scenario-1")
    curve = deceleration_curve(scenario.sample(1, 7).worlds, Task(scenario, (1,)))
    expected = {
        "front pair": [("B", [0.0, 4.151]), ("C", [4.1545, 4.718]), ("none", [4.7184, 7.0])],
        "rear pair": [("none", [0.0, 5.0103]), ("B", [5.012, 7.0])],
    }
    for pair, regimes in curve.regimes.items():
        ends = [np.flatnonzero(regimes == regime)[[0, -1]] for regime in dict.fromkeys(regimes)]
        found = [(str(regimes[a]), curve.deceleration_mps2[[a, b]].round(4).tolist()) for a, b in ends]
        assert found == expected[pair]
    spared = (curve.regimes["front pair"] == "none") & (curve.regimes["rear pair"] == "none")
    assert spared.any()
    assert not curve.predicted[spared].any()
    assert round(float(curve.predicted[-1]), 9) == 28.98


@pytest.mark.parametrize(
    ("gap", "speeds", "latency", "decelerations", "expected"),
    [
        (1.0, (20.0, 20.0), (0.0, 1.0), (6.0, 6.0), "A"),
        (10.0, (3.0, 10.0), (0.0, 2.0), (6.0, 6.0), "A'"),
        (10.0, (3.0, 10.0), (0.0, 0.5), (6.0, 2.0), "C"),
        (10.0, (3.0, 10.0), (0.0, 0.5), (6.0, 10.0), "none"),
        (1.0, (20.0, 20.0), (0.0, 0.5), (6.0, 6.0), "B"),
        (1.0, (5.0, 10.0), (1.0, 0.0), (6.0, 2.0), "early"),
    ],
)
def test_regimes__by_hand(gap, speeds, latency, decelerations, expected) -> None:
    # A: sqrt(2 / 6) = 0.577 s, before 1 s. A': the leader stands at 0.5 s, 5.75 m ahead; hit at 1.075 s. C: the same
    # leader; stopping takes 25 m of the 5.75 m; or 5 m. B: 0.25 m left at 0.5 s, 3 m/s closing for good. Early: 5 t -
    # t^2 = 1 at 0.21 s, before 1 s.
    worlds = line([[gap]], [speeds], latency_s=latency, mass_t=5.0, restitution=0.1)
    assert module.regimes_of(worlds, 0, np.array([decelerations])).tolist() == [expected]


def test_trajectories__draw_the_obstacle_ahead() -> None:
    scenario = load_scenario("cooperation-4-all").with_learners(["vehicle_1"])
    record = eb.record_episode(scenario.sample(1, 7).worlds, eb.make_agent("coast"), scenario=scenario)
    assert "obstacle" in trajectories({"coast": record}).axes[0].get_legend_handles_labels()[1]
