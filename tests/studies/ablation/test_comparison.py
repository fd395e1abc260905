"""What the comparison says, by hand."""

from __future__ import annotations

import csv
from dataclasses import replace

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg

from ethbrake_marl.figures import ablation_figures, signed_ticks
from ethbrake_marl.scenario import load_scenario
from ethbrake_marl.shield.guard import Shielded
from ethbrake_marl.studies.ablation import (
    FIGURES,
    Harms,
    Level,
    Measured,
    ablation_page,
    compare,
    interval_words,
    levels_csv,
    markdown,
)
from tests.pages.hostile import Page

WORLDS, SEARCHED = 40, 10


def harms(*seeds: tuple[float, float, float]) -> Harms:
    """The same harm of each vehicle in every world, one triple per seed; total harm is twice the first."""
    first = np.repeat(np.array(seeds)[:, np.newaxis, :], WORLDS, axis=1)
    vehicle = {"first": first, "total": 2.0 * first}
    world = {count: each.sum(axis=2) for count, each in vehicle.items()}
    return Harms(world, vehicle, first.sum(axis=2) > 0.0)


def measured(
    name: str, algorithm: str | None, reached: Harms, best: float | None, clear: str | None = None
) -> Measured:
    braking = harms((4.0, 8.0, 8.0))
    limit = (
        None if best is None else {"first": np.full((1, SEARCHED), best), "total": np.full((1, SEARCHED), 2.0 * best)}
    )
    return Measured(Level(load_scenario(name), clear), algorithm, reached, braking, limit)


@pytest.fixture(scope="module")
def ablation() -> list[Measured]:
    return [
        measured("cooperation-0-sensors", None, harms((4.0, 8.0, 8.0)), None),
        measured("cooperation-2-paper", "ppo", harms((5.0, 3.0, 2.0), (5.0, 5.0, 2.0)), 6.0),
        measured("cooperation-3-pair", "ppo", harms((1.0, 1.0, 3.0), (1.0, 1.0, 3.0)), 5.0),
        measured("cooperation-2-blocked", "ppo", harms((5.0, 4.0, 2.0)), 6.0, "cooperation-2-paper"),
    ]


@pytest.fixture(scope="module")
def found(ablation) -> dict:
    return compare(ablation, SEARCHED)


def test_compare__each_level(found):
    sensors, paper, pair, _ = found["levels"]
    assert paper["first"]["harm"]["value"] == pytest.approx(11.0)
    assert paper["first"]["harm"]["interval"] == pytest.approx([10.0, 12.0])
    assert paper["first"]["each_seed"] == pytest.approx([10.0, 12.0])
    assert paper["first"]["searched"]["realised_share"]["value"] == pytest.approx((20.0 - 11.0) / (20.0 - 6.0))
    assert paper["total"]["searched"]["best_known"]["value"] == pytest.approx(12.0)
    assert [one["value"] for one in paper["total"]["vehicles"]] == pytest.approx([10.0, 8.0, 4.0])
    assert sensors["first"]["searched"]["realised_share"] is None and sensors["algorithm"] is None
    assert pair["first"]["searched"]["realised_share"]["value"] == pytest.approx(1.0)
    assert pair["learners"] == ["vehicle_2", "vehicle_3"]


def test_compare__the_share_follows_from_what_stands_beside_the_joint_optimum(ablation):
    """The searched worlds are milder than the rest: nothing of the rest may stand in their row."""
    one = ablation[1]
    mild = np.where(np.arange(WORLDS) < SEARCHED, 0.75, 1.0)
    reached = replace(one.reached, world={count: harm * mild for count, harm in one.reached.world.items()})
    braking = replace(one.full_brake, world={count: harm * mild for count, harm in one.full_brake.world.items()})
    level = compare([replace(one, reached=reached, full_brake=braking)], SEARCHED)["levels"][0]["first"]
    row = level["searched"]
    assert (row["full_brake"]["value"], row["harm"]["value"], row["best_known"]["value"]) == (15.0, 8.25, 6.0)
    assert row["realised_share"]["value"] == pytest.approx((15.0 - 8.25) / (15.0 - 6.0))
    assert row["each_seed"] == [7.5, 9.0] and row["worlds"] == SEARCHED
    assert level["full_brake"]["value"] == pytest.approx(20.0 * mild.mean())


def test_compare__steps_of_the_ladder_and_lost_messages(found):
    first, second = found["steps"]
    assert (first["from"], first["to"]) == ("cooperation-0-sensors", "cooperation-2-paper")
    assert first["first"]["difference"]["value"] == pytest.approx(-9.0)
    assert first["first"]["worse_off"]["value"] == 1.0  # Vehicle 1, always
    assert first["first"]["worse_off_vehicles"] == [1.0, 0.0, 0.0]
    assert [one["value"] for one in second["first"]["vehicles"]] == pytest.approx([-4.0, -3.0, 1.0])
    assert second["total"]["difference"]["interval"][1] < 0.0
    (lost,) = found["channels"]
    assert (lost["from"], lost["to"]) == ("cooperation-2-paper", "cooperation-2-blocked")
    assert lost["first"]["difference"]["value"] == pytest.approx(0.0)
    assert lost["first"]["worse_off"]["value"] == 0.5  # Vehicle 2 against the first of two seeds


def test_tables__hold_the_same_figures(ablation, found):
    page = markdown(found, "40 worlds.")
    assert "| `cooperation-2-paper` | 100.0 % [91.2, 100.0] | 20.00 | 11.00 [10.00, 12.00] |" in page
    assert "| `cooperation-2-paper` | 20.00 | 11.00 [10.00, 12.00] | 6.00 | 64.3 % [" in page
    assert "How near the joint optimum, in the first 10 worlds" in page
    assert "| `cooperation-2-paper` | `cooperation-3-pair` | -6.00" in page and "Algorithm" not in page
    assert "Price of lost messages" in page and page.rstrip().endswith("40 worlds.")
    rows = list(csv.DictReader(levels_csv(ablation, SEARCHED).splitlines()))
    assert [(row["level"], row["seed"]) for row in rows[:3]] == [
        ("cooperation-0-sensors", ""), ("cooperation-2-paper", "0"), ("cooperation-2-paper", "1")
    ]  # fmt: skip
    assert float(rows[2]["first_impact_harm"]) == 12.0 and float(rows[2]["total_harm_2"]) == 10.0
    assert float(rows[1]["searched_best_known_total_harm"]) == 12.0 and rows[0]["searched_best_known_total_harm"] == ""


@pytest.fixture(scope="module")
def behind(ablation) -> list[Measured]:
    """The shield takes 2 from Vehicle 2 and gives 0.5 to Vehicle 3, in the first seed alone, in every second world."""
    shielded = {}
    for count in ("first", "total"):
        after = ablation[2].reached.vehicle[count].copy()
        after[0, ::2] += [0.0, -2.0, 0.5]
        replaced = np.zeros((2, WORLDS, 2), np.int64)
        replaced[0, ::2] = [10, 0]
        shielded[count] = Shielded(
            after.sum(axis=2), after, after.sum(axis=2) + 1.0, after, replaced, np.full((2, WORLDS), 50),
            np.zeros((2, WORLDS), np.bool_),
        )  # fmt: skip
    shielded["total"].bound[1, 3] = 0.0
    return [*ablation[:2], replace(ablation[2], shielded=shielded), ablation[3]]


def test_compare__behind_the_shield_stands_the_same_level_without_it(behind):
    found = compare(behind, SEARCHED)
    sensors, paper, pair, _ = found["levels"]
    assert sensors["first"]["shielded"] is None and paper["first"]["shielded"] is None
    told = pair["first"]["shielded"]
    assert told["harm"]["value"] == pytest.approx(5.0 - 1.5 / 4) and pair["first"]["harm"]["value"] == pytest.approx(
        5.0
    )
    assert told["difference"]["value"] == pytest.approx(-1.5 / 4) and told["each_seed"] == pytest.approx([4.25, 5.0])
    assert [one["value"] for one in told["vehicles"]] == pytest.approx([0.0, -0.5, 0.125])
    assert told["replaced"] == pytest.approx(0.25 * 0.2 / 2) and told["replaced_vehicles"] == pytest.approx([0.05, 0.0])
    assert told["stepped_in"]["value"] == told["worse_off"]["value"] == 0.25
    assert told["bound"]["value"] == pytest.approx(told["harm"]["value"] + 1.0)
    assert told["above_bound"] == 0 and pair["total"]["shielded"]["above_bound"] == 1
    assert told["above_baseline"]["value"] == 0.0 and told["searched"]["harm"]["value"] == pytest.approx(4.625)


def test_tables_and_figure__show_what_is_behind_the_shield(behind):
    found = compare(behind, SEARCHED)
    page = markdown(found, "40 worlds.")
    assert "Behind the step shield" in page and "| `cooperation-3-pair` | 5.00 | 4.62 | -0.38 [" in page
    assert "Behind" not in markdown(compare(behind[:2], SEARCHED), "40 worlds.")
    rows = list(csv.DictReader(levels_csv(behind, SEARCHED).splitlines()))
    assert rows[1]["shielded_first_impact_harm"] == "" and float(rows[3]["shielded_first_impact_harm"]) == 4.25
    assert float(rows[3]["actions_replaced_total_harm"]) == pytest.approx(0.05)
    assert float(rows[4]["bound_first_impact_harm"]) == pytest.approx(6.0)
    labels = [text.get_text() for text in ablation_figures(found, "40 worlds")[0].legends[0].get_texts()]
    assert "ppo, shielded" in labels
    texts = [text.get_text() for text in ablation_figures(compare(behind[:2], 10), "")[0].legends[0].get_texts()]
    assert "ppo, shielded" not in texts


def test_page__holds_the_tables_and_figures(found):
    figures = dict(zip(FIGURES, ablation_figures(found, "40 worlds"), strict=True))
    html = ablation_page({**found, "settings": {"seeds": 2, "machine": "</script><b>"}}, "40 worlds.", figures)
    shown = Page(html)
    assert shown.open == [] and not {"script", "b", "img"} & {tag for tag, _ in shown.tags}
    assert "cooperation-2-paper 100.0 % [91.2, 100.0] 20.00 11.00 [10.00, 12.00]" in shown.text
    assert shown.text.count("40 worlds.") == 1
    assert "`" not in shown.text and html.count("<figure>") == 3 and "</script><b>" in shown.text


@pytest.mark.parametrize(
    ("low", "high", "ticks"),
    [
        (-0.47, 0.05, [-0.2, -0.1, 0.0]),
        (-0.6, 0.3, [-0.3, -0.1, 0.0, 0.1, 0.3]),
        (-30.0, 12.0, [-10.0, -1.0, -0.1, 0.0, 0.1, 1.0, 10.0]),
        (-0.02, 0.0, [-0.01, -0.001, 0.0]),
        (0.0, 0.0, [0.0]),
    ],
)
def test_ticks__are_a_few_round_numbers(low, high, ticks):
    assert set(ticks) <= set(signed_ticks(low, high)) and len(signed_ticks(low, high)) <= 11


def test_figures__texts_stand_inside_and_the_colour_bar_reaches_its_end(found):
    _, figure, pays = ablation_figures(found, "40 worlds")
    FigureCanvasAgg(figure).draw()
    for axes in figure.axes:
        inside = axes.get_window_extent()
        for text in axes.texts:
            box = text.get_window_extent()
            assert inside.x0 <= box.x0 and box.x1 <= inside.x1 and box.y1 <= inside.y1
    bar = pays.axes[-1]
    assert max(bar.get_yticks()) >= 0.3 * bar.get_ylim()[1]


def test_tables__name_the_algorithm_where_there_are_two(ablation):
    other = measured("cooperation-2-paper", "sac", harms((5.0, 3.0, 2.0)), 6.0)
    page = markdown(compare([*ablation[:2], other], SEARCHED), "")
    assert "| `cooperation-2-paper` | sac | 100.0 %" in page and "| `cooperation-0-sensors` | – |" in page
    assert "| `cooperation-0-sensors` | `cooperation-2-paper` | sac | -10.00" in page


def test_figures__show_what_was_found(found):
    curve, changes, pays = ablation_figures(found, "40 worlds")
    ticks = [label.get_text() for label in curve.axes[0].get_xticklabels()]
    assert ticks == ["0\nsensors", "2\npaper", "3\npair"]
    assert [text.get_text() for text in curve.axes[0].texts] == ["blocked"]
    rows = [label.get_text() for label in changes.axes[0].get_yticklabels()]
    assert rows == ["0 sensors → 2 paper", "2 paper → 3 pair", "2 paper → 2 blocked"]
    assert "the first 10 worlds" in curve.get_supxlabel()
    assert "+1.00" in [text.get_text() for text in pays.axes[0].texts]


@pytest.mark.filterwarnings("error::UserWarning")
def test_figures__of_one_change_have_room_for_their_caption(ablation):
    found = compare(ablation[:2], SEARCHED)
    for figure in ablation_figures(found, "Conditions of this figure, in many words. " * 14):
        FigureCanvasAgg(figure).draw()
        bottom = min(axes.get_tightbbox().y0 for axes in figure.axes)
        assert figure._supxlabel.get_window_extent().y1 <= bottom + 1.0


def test_interval_words__say_what_so_many_seeds_can_tell():
    assert interval_words(1) == "95 % intervals for other worlds only: one seed says nothing about others"
    assert interval_words(2) == "95 % intervals for other seeds and other worlds (rough: 2 seeds)"
    assert interval_words(3) == "95 % intervals for other seeds and other worlds"
