"""``study ablate``: levels, trainings, joint optima, what is compared and shown."""

import json
import shutil
import signal
import time
from dataclasses import replace
from pathlib import Path

import ethbrake_marl.first_edition as eb
import numpy as np
import pytest
from ethbrake_marl.extensions.cooperation.joint_optimum import (
    Goal,
    Harms,
    LevelOptimum,
    Measured,
    best_known,
    measure,
    questions,
    search_all,
)
from ethbrake_marl.first_edition.evaluation.seeds import mean_over_seeds
from ethbrake_marl.first_edition.game.harm import HarmCount
from ethbrake_marl.first_edition.scenario.catalogue import load_scenario, scenario_path
from ethbrake_marl.first_edition.scenario.sample import Sample
from ethbrake_marl.first_edition.shields.episodes import Shielded
from ethbrake_marl.first_edition.training.callback import RunCallback
from ethbrake_marl.first_edition.training.recipe import Scheme, TrainingRecipe, load_recipe
from ethbrake_marl.first_edition.training.training import Training
from tests.first_edition.learning.tiny import TINY_PPO

from ethbrake_marl.cli.app import run_command
from ethbrake_marl.extensions.cooperation.comparison import compare
from ethbrake_marl.extensions.cooperation.levels import STANDARD, Level, Plan, common_worlds, read_levels, with_scheme
from ethbrake_marl.extensions.cooperation.results import levels_csv, tables
from ethbrake_marl.extensions.search.best_harm import best_harm, chunks_left
from ethbrake_marl.extensions.studies.trainings import TrainingJob
from tests.extensions.studies.conftest import ABLATE, LEVELS, study
from tests.extensions.studies.killing import PROGRAM, end_when
from tests.fixtures.snapshots import check_snapshot

SNAPSHOTS = Path(__file__).parent / "snapshots"


def content(folder: Path) -> dict:
    found = json.loads((folder / "ablation.json").read_text())
    found["settings"] = {k: v for k, v in found["settings"].items() if k not in ("machine", "date")}
    return {k: v for k, v in found.items() if k != "conditions"}


def ablate(folder: Path, recipe: Path, *options: object) -> int:
    return study("ablate", "--output", folder, "--recipes", recipe, *ABLATE, *options)


def test_ablate__writes_three_files(finished_ablation: Path) -> None:
    names = {path.name for path in finished_ablation.glob("ablation*")}
    assert names == {"ablation.json", "ablation.csv", "ablation.png"}
    found = content(finished_ablation)
    levels = found["levels"]
    assert [(each["level"], each["seeds"]) for each in levels] == list(zip(LEVELS.split(","), (1, 2, 2), strict=True))
    assert {found["kind"], *(level["kind"] for level in levels)} == {"ablate"}
    policies = [{seed.get("vehicle_2") for seed in level["policy_sha256"]} for level in levels]
    assert len({level["scenario_sha256"] for level in levels}) == 3 and list(map(len, policies)) == [1, 2, 2]
    assert len(levels[1]["worlds_sha256"]) == 64 and levels[1]["versions"]["numpy"] and policies[0] == {None}
    (step,) = found["channels"]
    assert (step["from"], step["to"]) == ("cooperation-3-pair", "cooperation-3-congested")
    searched = levels[1]["total"]["searched"]
    assert searched["best_known"]["value"] <= searched["full_brake"]["value"]


@pytest.mark.slow
def test_ablate__the_shield_goes_around_what_was_trained(finished_ablation, tmp_path, tiny_total, capsys) -> None:
    """The trainings of the other ablation are used, in a copy without its settings."""
    copied = Path(shutil.copytree(finished_ablation, tmp_path / "copy"))
    (copied / "settings.json").unlink()
    assert ablate(copied, tiny_total, "--shield", "step") == 0
    assert "to do: 0 trainings" in capsys.readouterr().err
    found, alone = content(copied), content(finished_ablation)
    assert (found["settings"]["shield"], alone["settings"]["shield"]) == ("step", None)
    assert found["levels"][0]["first"]["shielded"] is None
    for level, before in zip(found["levels"][1:], alone["levels"][1:], strict=True):
        for count in ("first", "total"):
            told = level[count].pop("shielded")
            assert told["above_bound"] == 0 and told["harm"]["value"] <= told["bound"]["value"]
            difference = told["harm"]["value"] - level[count]["harm"]["value"]
            assert told["difference"]["value"] == pytest.approx(difference) and difference < -1.0
            assert 0.1 < told["replaced"] == pytest.approx(sum(told["replaced_vehicles"]) / 2)
            assert before[count].pop("shielded") is None
    assert found["levels"][1:] == alone["levels"][1:]  # without the shield as before


@pytest.mark.slow
def test_ablate__goes_on_where_it_was_stopped_to_the_same_result(
    finished_ablation, tmp_path, tiny_total, monkeypatch, capsys
) -> None:
    """Stopped in the middle of a later training; ended by two processes."""
    folder, original = tmp_path / "stopped", RunCallback._between_updates

    def after_update(self, **options):
        original(self, **options)
        if self.run.path.name == "cooperation-3-congested-tiny-shared-seed0" and self.updates == 1:
            raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(RunCallback, "_between_updates", after_update)
        assert ablate(folder, tiny_total) == 130
    statuses = [json.loads(path.read_text())["status"] for path in folder.glob("trainings/*/run.json")]
    assert sorted(statuses) == ["finished", "interrupted"] and not (folder / "ablation.json").exists()
    capsys.readouterr()
    words = ["--output", str(folder), "--recipes", str(tiny_total), *ABLATE, "--jobs", "2"]
    assert run_command(["study", "ablate", *words]) == 0
    assert "to do: 3 trainings" in capsys.readouterr().err
    assert content(folder) == content(finished_ablation)


def planned(recipe: TrainingRecipe, scheme: Scheme | None) -> list[tuple[str, TrainingJob, TrainingRecipe]]:
    """Algorithm, training and its recipe, level by level."""
    levels = tuple(read_levels(["cooperation-2-paper", "cooperation-3-pair"]))
    plan = Plan(levels, (with_scheme(recipe, scheme),), 1, 300, 10, 7, 5, 10, Path("any"))
    return [(algorithm, job, job.training.recipe) for _, algorithm, job in plan.trainings()]


def test_plan__one_learner_is_trained_alone_several_by_their_scheme_and_turns(tiny_total):
    recipe = load_recipe(str(tiny_total))
    for scheme in (None, "shared"):
        (name, job, alone), (_, other, pair) = planned(recipe, scheme)
        assert (alone.scheme, alone.total_steps, pair.scheme, pair.total_steps) == (None, 300, "shared", 600)
        names = [each.folder.name for each in (job, other)]
        assert (
            names == ["cooperation-2-paper-tiny-seed0", "cooperation-3-pair-tiny-shared-seed0"]
            and name == "tiny-shared"
        )
    assert [own.scheme for *_, own in planned(recipe.replace(scheme="shared"), None)] == [None, "shared"]
    (*_, alone), (*_, pair) = planned(recipe.replace(scheme="independent", turns=2), None)
    assert (alone.turns, pair.turns) == (None, 2)


@pytest.mark.slow
def test_ablate__an_interruption_ends_the_trainings_of_other_processes(tmp_path: Path, tiny_total: Path) -> None:
    folder = tmp_path / "stopped"
    options = ["--levels", "cooperation-0-sensors,cooperation-2-paper", "--steps", "1000000", "--jobs", "2"]
    command = [*PROGRAM, "study", "ablate", "--output", folder, "--recipes", tiny_total, *ABLATE, *options]
    status, told = end_when(command, lambda _: len([*folder.glob("trainings/*/checkpoints")]) == 2, signal.SIGINT)
    assert status == 130 and "interrupted; the same command continues" in told
    runs = [*folder.glob("trainings/*")]
    before = [(run / "progress.csv").read_bytes() for run in runs]
    time.sleep(2.0)
    assert len(runs) == 2 and [(run / "progress.csv").read_bytes() for run in runs] == before


def test_results__show_what_was_found(levels, behind, found) -> None:
    """What stands there follows from the harms below by hand; a change shows in the snapshot."""
    shielded = compare(behind, SEARCHED)
    shown = [sheet.markdown() for told in (found, shielded) for sheet in tables(told)]
    check_snapshot(SNAPSHOTS / "ablation.txt", "\n\n".join([*shown, levels_csv(behind, SEARCHED)]) + "\n")
    check_snapshot(SNAPSHOTS / "ablation.json", json.dumps(shielded, indent=1) + "\n")


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
def levels() -> list[Measured]:
    return [
        measured("cooperation-0-sensors", None, harms((4.0, 8.0, 8.0)), None),
        measured("cooperation-2-paper", "ppo", harms((5.0, 3.0, 2.0), (5.0, 5.0, 2.0)), 6.0),
        measured("cooperation-3-pair", "ppo", harms((1.0, 1.0, 3.0), (1.0, 1.0, 3.0)), 5.0),
        measured("cooperation-2-blocked", "ppo", harms((5.0, 4.0, 2.0)), 6.0, "cooperation-2-paper"),
    ]


@pytest.fixture(scope="module")
def found(levels) -> dict:
    return compare(levels, SEARCHED)


def test_compare__the_share_follows_from_what_stands_beside_the_joint_optimum(levels):
    """The searched worlds are milder than the rest: nothing of the rest may stand in their row."""
    one = levels[1]
    mild = np.where(np.arange(WORLDS) < SEARCHED, 0.75, 1.0)
    reached = replace(one.reached, world={count: harm * mild for count, harm in one.reached.world.items()})
    braking = replace(one.full_brake, world={count: harm * mild for count, harm in one.full_brake.world.items()})
    level = compare([replace(one, reached=reached, full_brake=braking)], SEARCHED)["levels"][0]["first"]
    row = level["searched"]
    assert (row["full_brake"]["value"], row["harm"]["value"], row["best_known"]["value"]) == (15.0, 8.25, 6.0)
    assert row["share_of_possible_reduction"]["value"] == pytest.approx((15.0 - 8.25) / (15.0 - 6.0))
    assert row["each_seed"] == [7.5, 9.0] and row["worlds"] == SEARCHED
    assert level["full_brake"]["value"] == pytest.approx(20.0 * mild.mean())


def test_compare__worlds_of_one_recording_are_one_cluster(levels) -> None:
    one = levels[1]
    uneven = np.repeat([0.5, 0.7, 1.0, 1.8], WORLDS // 4)
    reached = replace(one.reached, world={count: harm * uneven for count, harm in one.reached.world.items()})
    alone = replace(one, reached=reached)
    together = replace(alone, clusters=np.repeat(["a", "b", "c", "d"], WORLDS // 4))
    narrow, wide = (compare([each, each], SEARCHED) for each in (alone, together))
    harms = [found["levels"][0]["first"]["harm"] for found in (narrow, wide)]
    assert harms[0]["value"] == harms[1]["value"]
    assert harms[1] == mean_over_seeds(reached.world["first"], clusters=together.clusters).to_json()
    assert np.ptp(harms[1]["interval"]) > 2.0 * np.ptp(harms[0]["interval"])


def test_undertrained__full_braking_does_better_is_said_in_results_and_figure(levels) -> None:
    told = "Not trained enough to say anything: cooperation-3-pair (ppo), total harm 38.20 (24.20 if everybody brakes"
    told += " fully)."
    worse, better = Goal("total harm", 38.2, 24.2), Goal("total harm", 24.2, 24.2)
    found = compare([levels[0], replace(levels[1], goal=better), replace(levels[2], goal=worse)], SEARCHED)
    assert found["undertrained"] == [told]
    assert [level["goal"] and level["goal"]["missed"] for level in found["levels"]] == [None, False, True]
    assert compare(levels, SEARCHED)["undertrained"] == []


@pytest.mark.parametrize(
    ("level", "harm_count", "name"),
    [("cooperation-2-paper", "first", "first-impact harm"), ("cooperation-1-front", "total", "objective")],
)
def test_goal__is_what_the_reward_counts(level: str, harm_count: HarmCount, name: str) -> None:
    """In ``cooperation-1-front`` Vehicle 2 looks after itself."""
    scenario = load_scenario(level)
    ledgers = [
        eb.evaluate(scenario.sample(30, 7), {agent: eb.make_agent(agent)}, scenario=scenario).outcome(agent).ledger
        for agent in ("coast", "full_brake")
    ]
    reached, braking = (
        Harms({harm_count: each.world_harm(harm_count)[np.newaxis]}, {}, each.collided[np.newaxis], (), (each,))
        for each in ledgers
    )
    recipe = TINY_PPO.replace(reward={"harm": 1.0, "harm_count": harm_count})
    goal = Goal.of(Training.of(recipe, scenario), reached, braking)
    means = [
        each.vehicle_harm(harm_count)[:, 1].mean() if name == "objective" else each.world_harm(harm_count).mean()
        for each in ledgers
    ]
    assert goal.name == name and [goal.reached, goal.full_brake] == pytest.approx(means)
    assert goal.missed and not goal._replace(reached=goal.full_brake).missed


def test_ablate__goals_are_those_of_the_recipe(finished_ablation: Path) -> None:
    found = content(finished_ablation)
    goals = [level.pop("goal") for level in found["levels"]]
    assert goals[0] is None
    for goal, level in zip(goals[1:], found["levels"][1:], strict=True):
        assert goal["name"] == "total harm"
        assert goal["reached"] == pytest.approx(level["total"]["harm"]["value"])
        assert goal["full_brake"] == pytest.approx(level["total"]["full_brake"]["value"])
        said = any(f" {level['level']} (" in line for line in found["undertrained"])
        assert said == goal["missed"] == (goal["reached"] > goal["full_brake"] + 1e-6)


@pytest.fixture(scope="module")
def behind(levels) -> list[Measured]:
    """The shield takes 2 from Vehicle 2 and gives 0.5 to Vehicle 3, in the first seed alone, in every second world."""
    shielded = {}
    for count in ("first", "total"):
        after = levels[2].reached.vehicle[count].copy()
        after[0, ::2] += [0.0, -2.0, 0.5]
        replaced = np.zeros((2, WORLDS, 2), np.int64)
        replaced[0, ::2] = [10, 0]
        shielded[count] = Shielded(
            after.sum(axis=2), after, after.sum(axis=2) + 1.0, after, replaced, np.full((2, WORLDS), 50),
            np.zeros((2, WORLDS), np.bool_),
        )  # fmt: skip
    shielded["total"].bound[1, 3] = 0.0
    return [*levels[:2], replace(levels[2], shielded=shielded), levels[3]]


LINES = 30


NAMES = ("cooperation-1-front", "cooperation-2-paper", "cooperation-3-pair", "cooperation-4-all")


def answer(level: Level, budget: int, agent: str = "full_brake") -> LevelOptimum:
    worlds = level.scenario.sample(LINES, 7).worlds
    table = best_harm(level.scenario, worlds, budget=budget, threads=1)
    return LevelOptimum(level, worlds, table, (eb.Team.of(eb.make_agent(agent), level.scenario.learners),))


@pytest.fixture(scope="module")
def answers() -> dict[str, LevelOptimum]:
    """Front does well by its policy alone, the paper by a long search, the pair and all three by neither."""
    front, paper, pair, everybody = read_levels(NAMES)
    found = [answer(front, 1, "e_v2x_bm"), answer(paper, 500), answer(pair, 1), answer(everybody, 1)]
    return {each.level.name: each for each in found}


def test_best_known__is_one_for_levels_that_ask_one_question(answers):
    front, paper = (best_known(answers[name], list(answers.values())) for name in NAMES[:2])
    scenario = answers[NAMES[0]].level.scenario
    policy = eb.evaluate(answers[NAMES[0]].worlds, {"e": eb.make_agent("e_v2x_bm")}, scenario=scenario).outcome("e")
    for count, harm in paper.items():
        np.testing.assert_array_equal(front[count], harm)
        assert (harm <= np.minimum(answers[NAMES[1]].searched.best[count].harm, policy.ledger.world_harm(count))).all()


def test_best_known__more_learners_are_never_worse_world_by_world(answers):
    """With the obstacle so far away that nobody reaches it."""
    far = load_scenario("cooperation-4-all").replace(obstacle_gap_m=200)
    every = [*list(answers.values())[:3], answer(Level(far), 1)]
    paper, pair, everybody = (best_known(each, every) for each in every[1:])
    for harm_count, harm in pair.items():
        assert (harm <= paper[harm_count] + 1e-9).all() and (everybody[harm_count] <= harm + 1e-9).all()
        assert harm.mean() < every[2].searched.best[harm_count].harm.mean() - 0.01
    with_obstacle = best_known(answers["cooperation-4-all"], list(answers.values()))
    for harm_count, best in answers["cooperation-4-all"].searched.best.items():
        assert with_obstacle[harm_count].mean() < best.harm.mean() - 0.1


def test_best_known__other_latencies_scripts_learners_or_times_count_for_nothing(answers):
    """Vehicle 3 of ``early`` may act 0.05 s before Vehicle 2: its decisions fall between those of Vehicle 2 alone."""
    pair, early = answers["cooperation-3-pair"], load_scenario("cooperation-3-pair").replace(latency_s=[0, 0.5, 0.45])
    late = replace(answers[NAMES[1]].worlds.vehicles, latency_s=pair.worlds.vehicles.latency_s + 0.1)
    coasting = load_scenario("cooperation-2-paper").replace(
        name="mine", roles={"vehicle_1": "coast", "vehicle_2": "learner"}
    )
    better = answer(Level(early.with_learners(["vehicle_2"])), 500)
    for own, others in (
        (pair, [replace(answers[NAMES[1]], worlds=replace(answers[NAMES[1]].worlds, vehicles=late))]),
        (pair, [answer(Level(coasting), 1), answers["cooperation-4-all"]]),
        (answer(Level(early), 1), [better]),
    ):
        alone = best_known(own, [own])
        for count, harm in best_known(own, [own, *others]).items():
            np.testing.assert_array_equal(harm, alone[count])
            assert own is pair or better.searched.best[count].harm.mean() < harm.mean()


def left(plan: Plan, level: Level, part: Sample) -> tuple[int, list[Path]]:
    return chunks_left(level.scenario, part, budget=plan.budget, chunks=plan.optimum_folder(level))


def test_questions__each_is_searched_once_and_what_is_kept_is_not_searched_again(tmp_path, tiny_total):
    levels = tuple(read_levels(NAMES))
    recipe = with_scheme(load_recipe(str(tiny_total)), None)
    plan = Plan(levels, (recipe,), 1, 300, 10, 7, 5, 10, tmp_path)
    samples = common_worlds(levels, 10, 7)
    asked = questions(plan, samples)

    def all_left() -> list[tuple[int, list[Path]]]:
        return [left(plan, level, part) for level, part, _ in asked]

    assert [[level.name for level in alike] for *_, alike in asked] == [list(NAMES[:2]), [NAMES[2]], [NAMES[3]]]
    assert all_left() == [(5, [])] * 3
    told = []
    search_all(plan, samples, 1, told.append)
    assert told == [eb.Progress(f"joint optimum of {name}", 5, 5) for name in (NAMES[0], *NAMES[2:])]
    assert all_left() == [(0, [])] * 3 and left(replace(plan, budget=11), *asked[0][:2]) == (5, [])
    fewer = questions(replace(plan, search_episodes=4), samples)[0]
    assert left(plan, *fewer[:2]) == (4, [])
    damaged = tmp_path / "optimum" / NAMES[2] / "0000000.npz"
    damaged.write_bytes(b"no table")
    assert all_left() == [(0, []), (5, [damaged]), (0, [])]


def test_measure__all_brake_fully_whatever_their_roles():
    braking = load_scenario("paper-random").replace(name="braking", roles={"vehicle_1": "full_brake"})
    coasting = braking.replace(name="coasting", roles={"vehicle_1": "full_brake", "vehicle_3": "coast"})
    plan = Plan((Level(braking), Level(coasting)), (), 1, 1, 20, 7, 5, 10, Path("unused"))
    first, second = measure(plan)
    worlds = coasting.sample(20, 7)
    told = eb.evaluate(worlds, {"b": eb.make_agent("full_brake")}, scenario=braking, vehicle="vehicle_2").outcome("b")
    np.testing.assert_allclose(second.full_brake.world["total"][0], told.total_harm, rtol=1e-12, atol=1e-12)
    np.testing.assert_array_equal(first.reached.world["total"], second.full_brake.world["total"])
    assert second.reached.world["total"].mean() > 2.0 * told.total_harm.mean()


def test_standard_levels__are_a_ladder_and_its_worse_channels(empty_folder: Path) -> None:
    assert [
        (level.name, [vehicle + 1 for vehicle in level.scenario.learners], level.clear)
        for level in read_levels([*STANDARD, "cooperation-3-congested"])
    ] == [
        ("cooperation-0-sensors", [], None),
        ("cooperation-1-front", [2], None),
        ("cooperation-2-paper", [2], None),
        ("cooperation-3-pair", [2, 3], None),
        ("cooperation-4-all", [1, 2, 3], None),
        ("cooperation-2-blocked", [2], "cooperation-2-paper"),
        ("cooperation-3-congested", [2, 3], "cooperation-3-pair"),
    ]
    text = scenario_path("cooperation-2-paper").read_text().replace("v2x: paper", "v2x: nominal")
    Path("mine.yaml").write_text(text.replace("name: cooperation-2-paper", "name: mine"))
    assert [level.clear for level in read_levels(["cooperation-2-paper", "mine.yaml"])] == [None, "cooperation-2-paper"]
    assert [level.clear for level in read_levels(["mine.yaml", "cooperation-2-paper"])] == [None, "mine"]


def test_levels__are_compared_in_the_same_gaps_and_speeds() -> None:
    every = [sample.worlds for sample in common_worlds(read_levels(STANDARD), 50, 7)]
    assert len(every) == 6
    assert {worlds.gaps_m.tobytes() for worlds in every} == {every[0].gaps_m.tobytes()}
    assert {worlds.speeds_mps.tobytes() for worlds in every} == {every[0].speeds_mps.tobytes()}


def test_best_known__counts_an_obstacle_that_is_reached() -> None:
    # All brake fully: without an obstacle it is harmless; one 20 m ahead stands where Vehicle 1 runs into it.
    pair = load_scenario("cooperation-3-pair").replace(gaps_m=60)
    near = pair.replace(name="near", roles=dict.fromkeys(pair.vehicle_names, "learner"), obstacle_gap_m=20)
    answers = [answer(Level(pair), 1), answer(Level(near), 1)]
    assert best_known(answers[0], answers)["total"].max() == 0.0
    assert best_known(answers[1], answers)["total"].min() > 0.0
