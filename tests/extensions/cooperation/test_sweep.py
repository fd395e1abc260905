"""``study ablate --sweep``: one level with several numbers of one key."""

import csv
import json
from pathlib import Path

import numpy as np
import pytest

import ethbrake_marl.first_edition as eb
from ethbrake_marl.extensions.cooperation.comparison import compare
from ethbrake_marl.extensions.cooperation.joint_optimum import Harms, LevelOptimum, Measured, best_known
from ethbrake_marl.extensions.cooperation.levels import Level, Plan, common_worlds, plan_ablation
from ethbrake_marl.extensions.cooperation.results import levels_csv
from ethbrake_marl.extensions.cooperation.sweep import Swept
from ethbrake_marl.extensions.search.best_harm import best_harm
from tests.fixtures.commands import Command, Refuse
from tests.fixtures.pictures import draw_nothing


@pytest.mark.parametrize(
    ("text", "settings"),
    [
        ("objective=social:0..90:45", ["objective=social:0", "objective=social:45", "objective=social:90"]),
        ("v2x.lost=0,0.1,0.3", ["v2x.lost=0", "v2x.lost=0.1", "v2x.lost=0.3"]),
        ("v2x.lost=0..0.3:0.1", ["v2x.lost=0", "v2x.lost=0.1", "v2x.lost=0.2", "v2x.lost=0.3"]),
        ("friction = 0.9, 0.2..0.4:0.1, 10", [f"friction={each}" for each in ("0.2", "0.3", "0.4", "0.9", "10")]),
        ("k=-0.5..0.5:0.5", ["k=-0.5", "k=0", "k=0.5"]),
        ("objective=social:45,social:0,social:5", ["objective=social:0", "objective=social:5", "objective=social:45"]),
        ("objective=social:45,0", ["objective=social:0", "objective=social:45"]),
    ],
)
def test_parse__ranges_and_lists_in_ascending_order(text: str, settings: list[str]) -> None:
    values = Swept.parse(text)
    assert [each.setting for each in values] == settings
    assert [each.number for each in values] == [float(each.replace(":", "=").split("=")[-1]) for each in settings]


REFUSED = {
    "objective=own,total": "must be KEY=LOW..HIGH:STEP",
    "friction=0.5,nan": "must be KEY=LOW..HIGH:STEP",
    "objective=social:0..100:15": "equal steps",
    "friction=1..0.5:0.1": "equal steps",
    "friction=0.5..1:-0.1": "equal steps",
    "friction=0.5": "give 2 to 100 numbers",
    "friction=0..60:1,100..160:1": "give 2 to 100 numbers",
    "friction=0.5,0.50": "given twice",
    "averaging=0.9,0.99": "only a key of a scenario can be swept",
    "vehicles=2,3": "cannot be compared",
    "friction=0.5,0.6 --sweep v2x.lost=0,0.1": "--sweep is given twice",
    "friction=0.5,0.6 --set friction=1": "--set changes the same key",
    "friction=0.5,0.6 --levels cooperation-3-pair,cooperation-4-all": "a sweep needs",
    "friction=0.5,0.6 --levels cooperation-0-sensors": "no level has a learner",
    "objective=social:0,90 --set reward.objective=own": "has its own objective",
}


@pytest.mark.parametrize("words", REFUSED)
def test_sweep__is_refused(words: str, refuse: Refuse) -> None:
    refuse(f"study ablate --output new --cost --sweep {words}", REFUSED[words])


def plan(sweep: str, folder: Path = Path("any"), **given: object) -> Plan:
    return plan_ablation("cooperation-3-pair", "cooperation", None, sweep=sweep, folder=folder, **given)


def test_levels__are_one_level_with_the_numbers() -> None:
    levels = plan("scenario.v2x.lost=0.3,0").levels
    assert [level.name for level in levels] == ["cooperation-3-pair-v2x.lost-0", "cooperation-3-pair-v2x.lost-0.3"]
    assert [level.scenario.v2x.channel.lost for level in levels] == [0.0, 0.3]
    assert [level.clear for level in levels] == [None, None]
    (*_, (level, _, job)) = plan("objective=social:0,90", seeds=2).trainings()
    assert (level.scenario.objective, job.noted) == ("social:90", ("objective=social:90",))
    assert job.folder.name == "cooperation-3-pair-social-90-cooperation-shared-seed1"


def test_worlds__differ_in_the_swept_key_alone() -> None:
    light, heavy = (sample.worlds for sample in common_worlds(plan("mass_t.2=5,40").levels, 20, 7))
    assert set(light.vehicles.mass_t[:, 2]) == {5.0} and set(heavy.vehicles.mass_t[:, 2]) == {40.0}
    np.testing.assert_array_equal(light.gaps_m, heavy.gaps_m)
    np.testing.assert_array_equal(light.speeds_mps, heavy.speeds_mps)


def test_best_known__counts_for_other_numbers_only_on_the_same_lines() -> None:
    """A long search of the second level helps the first if they differ in the objective, not if in a mass."""
    for sweep, helps in (("objective=social:0,90", True), ("mass_t.2=5,40", False)):
        own, other = (
            LevelOptimum(level, worlds, best_harm(level.scenario, worlds, budget=budget, threads=1), ())
            for level, budget in zip(plan(sweep).levels, (1, 500), strict=True)
            for worlds in (level.scenario.sample(20, 7).worlds,)
        )
        alone, both = best_known(own, [own])["total"], best_known(own, [own, other])["total"]
        assert (both.mean() < alone.mean() - 0.1) == helps and (helps or (both == alone).all())


WORLDS, SEARCHED = 40, 10


def harms(*seeds: tuple[float, float, float]) -> Harms:
    """The same harm of each vehicle in every world, one triple per seed; total harm is twice the first."""
    first = np.repeat(np.array(seeds)[:, np.newaxis, :], WORLDS, axis=1)
    vehicle = {"first": first, "total": 2.0 * first}
    world = {count: each.sum(axis=2) for count, each in vehicle.items()}
    return Harms(world, vehicle, first.sum(axis=2) > 0.0)


@pytest.fixture(scope="module")
def measured() -> list[Measured]:
    """Two seeds at 0, 30 and 90 degrees; line harms are 12 and 10, 9 and 9, 8 and 6."""
    reached = (
        harms((5.0, 4.0, 3.0), (5.0, 2.0, 3.0)),
        harms((4.0, 4.0, 1.0), (4.0, 4.0, 1.0)),
        harms((3.0, 4.0, 1.0), (1.0, 4.0, 1.0)),
    )
    best = {"first": np.full((1, SEARCHED), 5.0), "total": np.full((1, SEARCHED), 10.0)}
    values = Swept.parse("objective=social:0,30,90")
    scenario = eb.load_scenario("cooperation-3-pair")
    return [
        Measured(Level(scenario, swept=value), "ppo", each, harms((4.0, 8.0, 8.0)), best)
        for value, each in zip(values, reached, strict=True)
    ]


def test_tables__have_the_key_and_the_number_as_columns(measured: list[Measured]) -> None:
    found = compare(measured, SEARCHED)
    keys = ("swept_key", "swept_value", "swept_number")
    rows = [("objective", "social:0", 0.0), ("objective", "social:30", 30.0), ("objective", "social:90", 90.0)]
    assert [tuple(level[key] for key in keys) for level in found["levels"]] == rows
    assert [level["first"]["harm"]["value"] for level in found["levels"]] == [11.0, 9.0, 7.0]
    assert [(s["from_number"], s["to_number"], s["first"]["difference"]["value"]) for s in found["steps"]] == [
        (0.0, 30.0, -2.0),
        (30.0, 90.0, -2.0),
    ]
    table = list(csv.DictReader(levels_csv(measured, SEARCHED).splitlines()))
    told = [(row["swept_key"], row["swept_number"], row["seed"], row["first_impact_harm"]) for row in table]
    shown = [("objective", "0.0", "0", "12.0"), ("objective", "0.0", "1", "10.0"), ("objective", "30.0", "0", "9.0")]
    assert told[:3] == shown


SMALL = "--seeds 1 --steps 128 --episodes 20 --search-episodes 4"


def test_sweep__costs_runs_and_goes_on(
    ethbrake: Command, empty_folder: Path, tiny_recipe: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    draw_nothing(monkeypatch)
    line = f"study ablate --sweep objective=social:0,90 --recipes {tiny_recipe} {SMALL} --output out --json"
    cost = ethbrake(*line.split(), "--cost")
    assert cost.status == 0 and list(Path().iterdir()) == []
    told = json.loads(cost.out)
    assert (told["trainings"], told["training_folders"], told["search_folders"], told["decisions"]) == (2, 2, 1, 512)
    parts = [told[name] for name in ("training_s", "search_s", "driving_s")]
    assert min(parts) > 0.0 and told["total_s"] == pytest.approx(sum(parts)) and "processor time" in told["measured"]

    assert ethbrake(*line.split()).status == 0
    out = Path("out")
    names = [f"cooperation-3-pair-social-{number}" for number in (0, 90)]
    folders = sorted(each.name for each in out.glob("trainings/*"))
    assert folders == [f"{name}-tiny-shared-seed0" for name in names]
    assert [each.name for each in out.glob("optimum/*")] == names[:1]  # one search: the objective changes no worlds
    found = json.loads((out / "ablation.json").read_text())
    assert found["settings"]["sweep"] == "objective=social:0,90" and found["channels"] == []

    again = ethbrake(*line.split())
    assert again.status == 0 and "to do: 0 trainings, 0 decisions" in again.err
    assert json.loads(again.out)["levels"] == found["levels"]
    other = ethbrake(*line.replace("0,90", "0,45,90").split())
    assert other.status == 2 and "contains an ablation with other settings (levels)" in other.err
    (out / "settings.json").unlink()
    more = ethbrake(*line.replace("0,90", "0,45,90").split(), "--cost")
    told = json.loads(more.out)
    assert (told["trainings"], told["training_folders"], told["search_s"]) == (1, 3, 0.0)
