"""The paper made again: verdicts that follow from numbers, its items, and the folder and pages of a reproduction."""

from collections.abc import Mapping
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure

import ethbrake_marl.first_edition as eb
from ethbrake_marl.extensions.report.paper_rows import PAPER_ROWS, PaperRow
from ethbrake_marl.extensions.report.seed_curves import SeedCurve
from ethbrake_marl.extensions.reproduction import delay_curves, folder as folder_module, hybrid, trainings
from ethbrake_marl.extensions.reproduction.delay_curves import Course
from ethbrake_marl.extensions.reproduction.folder import Drawn, Item, Made, Reproduction, checked_result, stated
from ethbrake_marl.extensions.reproduction.items import ITEMS, read_results
from ethbrake_marl.extensions.reproduction.making import choose_items, make_items, open_folder
from ethbrake_marl.extensions.reproduction.pages import render_page
from ethbrake_marl.extensions.reproduction.strategies import FULL_BRAKE, NAMES, READINGS, lineup
from ethbrake_marl.extensions.reproduction.tables import (
    NOBODY,
    Beside,
    compare_rows,
    decrease_verdict,
    rows_table,
    selection_verdict,
)
from ethbrake_marl.extensions.reproduction.trainings import Group, TrainedRecipe
from ethbrake_marl.extensions.reproduction.verdicts import (
    HARM,
    PERCENT,
    Less,
    Verdict,
    compare_number,
    judge_statement,
    summarise_verdicts,
)
from ethbrake_marl.files.sheet import Estimate, Sheet
from ethbrake_marl.first_edition.evaluation.statistics import rate
from tests.first_edition.learning.tiny import TINY_PPO
from tests.fixtures.page import Page
from tests.fixtures.snapshots import check_snapshot

SNAPSHOTS = Path(__file__).parent / "snapshots"
HOSTILE = "<script>alert('x')</script>\"|*_\u202e"


def made(text: str = "told", figures: Mapping[Drawn, Figure] | None = None) -> Made:
    """What an item may give, with one text everywhere."""
    sheet = Sheet(text, (text, text), ((text, text),), text)
    verdicts, parameters = (Verdict(text, "agrees", text),), (stated(text, text, text),)
    return Made(verdicts, parameters, (sheet,), figures or {}, {"data": "a,b\n"}, (text,))


def planted(name: str, make) -> Item:
    """An item of a known name that does something else."""
    return Item(name, ("label",), "A title", "What it is.", make, 3)


def around(value: float, half: float) -> Estimate:
    return Estimate(value, (value - half, value + half))


FEW, MANY = rate(65, 100), rate(6_500, 10_000)


LEAST_FEW, LEAST = ("worlds", rate(63, 100)), ("worlds", rate(6_256, 10_000))


@pytest.mark.parametrize(
    ("printed", "ours", "how", "outcome", "because"),
    [
        (11.4, around(10.0, 1.0), {}, "agrees", None),  # two lists may be sqrt 2 apart
        (11.5, around(10.0, 1.0), {}, "differs", None),
        (8.6, around(10.0, 1.0), {}, "agrees", None),
        # chance 2.8: it shows nothing
        (11.4, around(10.0, 2.0), {}, "undecided", "ours 10.00 [8.00, 12.00], printed 11.400: too few worlds to tell"),
        (10.1, around(10.0, 2.0), {}, "agrees", None),  # within the tolerance all the same
        (13.0, around(10.0, 2.0), {}, "differs", None),
        (0.95, around(0.945, 0.001), {}, "agrees", None),  # within the tolerance of the printed number
        (0.97, around(0.945, 0.001), {}, "differs", None),
        (0.617, MANY, {"least": LEAST}, "differs", None),  # a bound within chance of the printed number proves nothing
        (0.5974, FEW, {"least": LEAST_FEW}, "undecided", None),
        (
            0.5974,
            MANY,
            {"least": LEAST, "show": PERCENT},
            "cannot agree",
            "worlds: at least 62.6 % [61.6, 63.5], whoever drives; ours 65.0 % [64.1, 65.9], printed 59.74 %",
        ),
        (
            33.6,
            around(24.2, 0.3),
            {"others": {"at 0.2 s": around(33.4, 0.3), "total": around(25.0, 0.3)}},
            "differs",
            "ours 24.20 [23.90, 24.50], printed 33.600 (-28.0 %);"
            " nearest: at 0.2 s, 33.40 [33.10, 33.70], which agrees",
        ),
        (
            33.6,
            around(24.2, 0.3),
            {"others": {"total": around(20.0, 0.3)}},
            "differs",
            "ours 24.20 [23.90, 24.50], printed 33.600 (-28.0 %); no other reading here comes nearer",
        ),
    ],
)
def test_compare_number__follows_from_chance_tolerance_and_bound(printed, ours, how, outcome, because) -> None:
    verdict = compare_number("harm", printed, ours, **how)
    assert (verdict.outcome, because or verdict.because) == (outcome, verdict.because)


A, B, ZERO = Less("a", around(-3.0, 1.0)), Less("b", around(-2.0, 1.5)), Less("z", around(0.0, 0.0))
NEITHER = replace(ZERO, neither=True)


@pytest.mark.parametrize(
    ("parts", "or_equal", "outcome", "because"),
    [
        ([A, B], False, "agrees", "holds in 2 of 2; the nearest is b, -2.00 [-3.50, -0.50]"),
        ([A], False, "agrees", "a, -3.00 [-4.00, -2.00]"),
        ([A, Less("b", around(2.0, 1.5))], False, "differs", "holds in 1 of 2; not so: b, 2.00 [0.50, 3.50]"),
        ([Less("b", Estimate(0.5, None))], False, "differs", "not so: b, 0.50"),
        ([A, Less("b", around(-1.0, 1.5))], False, "undecided", "holds in 1 of 2; not shown: b, -1.00 [-2.50, 0.50]"),
        ([Less("a", around(3.0, 1.0)), Less("b", around(-1.0, 1.5))], False, "differs", None),
        ([A, NEITHER], False, "agrees", "holds in 1 of 1 (both are 0 in z); the nearest is a, -3.00 [-4.00, -2.00]"),
        ([NEITHER], False, "agrees", "nothing to undercut: both are 0 in z"),
        ([ZERO], True, "agrees", None),
        ([ZERO], False, "differs", None),
        ([Less("a", around(0.0, 0.1))], True, "undecided", None),
        (
            [A, Less("b", around(1.0, 0.5), least=around(0.4, 0.1))],
            False,
            "cannot agree",
            "holds in 1 of 2; the harm proven to be the least is above it in: b by 0.40 [0.30, 0.50]",
        ),
        ([Less("b", around(1.0, 0.5), least=around(0.1, 0.2))], False, "differs", None),
    ],
)
def test_judge_statement__holds_where_every_interval_is_below_zero(parts, or_equal, outcome, because) -> None:
    verdict = judge_statement("lower", parts, or_equal=or_equal)
    assert (verdict.outcome, because or verdict.because) == (outcome, verdict.because)


AS_STATED, AT_200_MS = READINGS


def printed(table: str, agent: str) -> PaperRow:
    return next(row for row in PAPER_ROWS if (row.table, row.agent) == (table, agent))


def beside(reading, worlds: int) -> Beside:
    scenario = reading.scenario("paper-random")
    agents = lineup(scenario, FULL_BRAKE)
    evaluation = eb.evaluate(scenario.sample(worlds, 7), agents, scenario=scenario, aftermath=False)
    return Beside(reading.name, evaluation, {"Non-E": (NAMES[FULL_BRAKE],), "Hybrid PPO": (NAMES[FULL_BRAKE],)})


def test_compare_rows__full_braking_agrees_at_200_ms_and_the_hybrid_is_excluded_as_stated() -> None:
    besides = [beside(AS_STATED, 1_000), beside(AT_200_MS, 1_000)]
    rows = [printed("random test", agent) for agent in ("Non-E", "Hybrid PPO")]
    found = {verdict.what: verdict for verdict in compare_rows(rows, besides)}
    stated, early = found["Non-E, average harm (as stated)"], found[f"Non-E, average harm ({AT_200_MS.name})"]
    assert (stated.outcome, early.outcome) == ("differs", "agrees")
    assert f"nearest: {NAMES[FULL_BRAKE]} ({AT_200_MS.name})" in stated.because
    assert found["Hybrid PPO, collision rate (as stated)"].outcome in ("cannot agree", "differs")
    (first, *_) = compare_rows([replace(rows[1], collision_rate=0.3)], besides)
    assert first.outcome == "cannot agree"
    assert "in which no command avoids an impact: at least" in first.because
    own, table = besides[0].numbers, rows_table(besides[0])
    assert own[NOBODY]["collision rate"].value <= own[NAMES[FULL_BRAKE]]["collision rate"].value
    assert table.rows[-1][0] == NOBODY and {len(row) for row in table.rows} == {len(table.columns)}


OUTCOMES = {"agrees", "differs", "cannot agree", "undecided", "not run"}


@pytest.fixture(scope="module")
def made_of(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Made]:
    """Every item of four worlds, made once."""
    settings = Reproduction("quick", tmp_path_factory.mktemp("reproduction"), 4)
    return {item.name: item.make(settings) for item in ITEMS}


@pytest.mark.parametrize("name", [item.name for item in ITEMS])
def test_item__has_verdicts_parameters_tables_and_data(made_of: dict[str, Made], name: str) -> None:
    told = made_of[name]
    assert told.verdicts and {verdict.outcome for verdict in told.verdicts} <= OUTCOMES
    assert all(verdict.because for verdict in told.verdicts)
    text = " ".join(verdict.what for verdict in told.verdicts)
    assert name == "gaps" or ("as stated" in text and "0.2 s" in text)  # the register has it as one of its rows
    of_paper = {parameter.name for parameter in told.parameters if parameter.origin.startswith("stated")}
    assert of_paper >= {"masses", "braking capacities"} and not of_paper & {"restitution e", "time step", "horizon"}
    assert told.tables and all(len(row) == len(table.columns) for table in told.tables for row in table.rows)
    assert told.data and all(text.count("\n") > 1 for text in told.data.values())
    assert told.figures or name in ("hybrid-table", "random-table", "learning-high", "learning-low")


@pytest.fixture
def settings(tmp_path: Path) -> Reproduction:
    """A quick reproduction of few worlds."""
    return Reproduction("quick", tmp_path / "out", 24, machine="a machine")


def test_page__whatever_a_result_says_is_text_and_no_name_leads_elsewhere(settings: Reproduction) -> None:
    own = replace(settings, folder=settings.folder.parent / "<b>out</b>'\"; {{ 7 * 7 }}\u202e")
    (result,), _ = make_items(own, [planted("gaps", lambda s: made(HOSTILE))])
    page = (own.folder / "index.html").read_text("utf-8")
    assert "<script" not in page and "&lt;script&gt;" in page and "\u202e" not in page
    assert own.folder.name not in page and "data-episodes" not in page
    hostile = replace(result, name="javascript:alert(1)", data=["//x", '" onclick="'])
    shown = Page(render_page(own.folder, [hostile]))
    links = [attributes["href"] for tag, attributes in shown.tags if tag == "a"]
    assert links[-2:] == ["./javascript%3Aalert%281%29/%2F%2Fx", "./javascript%3Aalert%281%29/%22%20onclick%3D%22"]
    assert not any(name.startswith("on") for _, attributes in shown.tags for name in attributes)


def test_make__keeps_what_is_there_and_makes_it_again_by_force_or_for_other_settings(settings: Reproduction) -> None:
    calls = []
    items = [planted("gaps", lambda s: calls.append(1) or made())]
    for force, number in ((False, 1), (False, 1), (True, 2)):
        make_items(settings, items, force=force)
        assert len(calls) == number
    open_folder(replace(settings, episodes=30), force=True)
    assert read_results(settings.folder) == []


def test_trajectories__of_the_scenarios_have_no_impact_under_the_policies(made_of: dict[str, Made]) -> None:
    (table,) = made_of["trajectories"].tables
    assert {row[3] for row in table.rows if row[2] in ("PPO", "SAC")} == {0}


def test_hybrid__is_driven_anew_once_its_policy_was_trained(
    settings: Reproduction, monkeypatch: pytest.MonkeyPatch
) -> None:
    first, again = (hybrid._drive_hybrid("paper-random", settings, READINGS[0]) for _ in range(2))
    assert again is first
    monkeypatch.setattr(hybrid, "unconverged_policy", lambda _: (eb.load_shipped("ppo"), "trained since"))
    assert hybrid._drive_hybrid("paper-random", settings, READINGS[0]) is not first


def hidden(folder: Path) -> list[Path]:
    return [path for path in folder.rglob(".*") if path.name != ".lock"]


def test_pages__tell_everything_that_a_result_holds(settings: Reproduction) -> None:
    """Their texts are those of the snapshot, also of a result of earlier versions, which tells no worlds."""
    sheet = Sheet("A table", ("Who", HARM), (("PPO", Estimate(1.5, (1.25, 1.75))),), "Of 24 worlds.")
    own = replace(settings, machine="a CPU, load 3.1, numpy 2.4.6")
    (result,), _ = make_items(own, [planted("gaps", lambda s: replace(made(), tables=(sheet,)))])
    content = {name: value for name, value in asdict(result).items() if name != "episodes"}
    earlier = Page(render_page(own.folder, [checked_result(content, "result.json", "gaps")]))
    page = Page((own.folder / "index.html").read_text("utf-8"))
    texts = "\n\n".join([page.text, earlier.text])
    check_snapshot(SNAPSHOTS / "reproduction.txt", texts.replace(result.made_utc[:10], "(today)"))
    assert page.open == []
    links = [attributes["href"] for tag, attributes in page.tags if tag == "a"]
    assert "./gaps/data.csv" in links and links.count("#a-title") == 1
    around = [attributes.get("class") for tag, attributes in page.tags if tag == "div"]
    assert around.count("wide") == sum(tag == "table" for tag, _ in page.tags) == 4


def test_reproduce__an_interruption_leaves_whole_files_and_goes_on(settings: Reproduction) -> None:
    def stop(_: Reproduction):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        make_items(settings, [planted("harm-delays", lambda s: made()), planted("gaps", stop)])
    assert [each.name for each in read_results(settings.folder)] == ["harm-delays"]
    assert "A title" in (settings.folder / "index.html").read_text("utf-8")
    assert hidden(settings.folder) == []
    results, _ = make_items(settings, [planted("harm-delays", stop), planted("gaps", lambda s: made())])
    assert [each.name for each in results] == ["harm-delays", "gaps"]


TINY = TINY_PPO.replace(total_steps=128 * 8, evaluation={"every_updates": 1, "worlds": 5, "seed": 7})


@pytest.mark.usefixtures("undrawn")
def test_full__trains_draws_and_keeps_what_is_trained(settings: Reproduction, monkeypatch) -> None:
    """One training of a second at either delay, in the place of all."""
    trained = {"ppo": (TrainedRecipe("ppo", TINY.total_steps, 1, 1000), TINY)}
    groups = {delay: Group(delay, f"paper-delay-{delay}", trained, 1) for delay in ("low", "high")}
    monkeypatch.setattr(folder_module, "groups", lambda: groups)
    monkeypatch.setattr(delay_curves, "CURVES", {"low": ("low",), "high": ("high",)})
    full = replace(settings, mode="full", episodes=5)
    (item,) = choose_items(["learning-low"])
    small = replace(item, trained=("low", "high"))
    assert full.seconds_left(small.trained) == pytest.approx(2 * 1.024)
    (result,), finished = make_items(full, [small])
    assert finished and result.trained == ["low/ppo", "high/ppo"] and full.seconds_left(small.trained) == 0.0
    assert [each.stem for each in result.figures] == ["learning-low-ours"]
    assert "1 seeds of ppo to 1,024 decisions" in result.notes[0] and "sac" in result.notes[1]
    (higher,) = [each for each in result.comparisons if each.what.startswith("both algorithms reach higher")]
    assert higher.outcome in ("agrees", "differs")
    before = {path: path.stat().st_mtime_ns for path in (full.folder / "trainings").rglob("run.json")}
    make_items(full, [small], force=True)
    assert before == {path: path.stat().st_mtime_ns for path in before} and len(before) == 2


def test_full__interrupted_makes_what_is_finished_and_an_item_again_when_more_is_trained(
    settings: Reproduction, monkeypatch
) -> None:
    full, calls, trained, whole = replace(settings, mode="full"), [], {}, [False, True, True, True]
    monkeypatch.setattr(Reproduction, "train", lambda *given: whole.pop(0))
    monkeypatch.setattr(Reproduction, "trained", lambda *given: trained)
    gaps = replace(planted("gaps", lambda s: calls.append(1) or made()), trained=("open",))
    results, finished = make_items(full, [gaps, planted("harm-delays", lambda s: made())])
    assert not finished and [each.name for each in results] == ["harm-delays", "gaps"]
    for more, number in (({}, 1), ({}, 1), ({"open/ppo-paper": []}, 2)):
        trained |= more
        make_items(full, [gaps])
        assert len(calls) == number


def test_groups__fit_their_recipes_and_every_item_names_groups_that_exist() -> None:
    found = trainings.groups()
    assert {name for item in ITEMS for name in item.trained} == set(found)
    for group in found.values():
        for name, (asked, recipe) in group.trained.items():
            assert recipe.name == name and recipe.total_steps == asked.decisions
            stated = eb.load_recipe(asked.recipe)
            if asked.recipe.endswith("-paper"):  # the paper's table stays as it is
                for key in ("gamma", "batch_size", "network"):
                    assert getattr(recipe, key) == getattr(stated, key)


def course(returns: list[list[float]], harm: list[list[float]]) -> Course:
    steps = np.arange(len(returns[0]), dtype=float)
    return Course(SeedCurve(steps, np.array(returns)), SeedCurve(steps, np.array(harm)))


def test_course_of_a_training__by_hand() -> None:
    # Measures of planted courses of a training: changes of 2 and 0, then of 3 and 0.
    one = course([[-10.0, -4.0, 0.0, 0.0], [-10.0, -6.0, 0.0, 0.0]], [[100.0, 50.0, 10.0, 0.0], [100.0, 5.0, 1.0, 0.0]])
    assert [
        np.round(measure, 9).tolist()
        for measure in (one.last_returns, one.decisions_to_converge, one.spread, one.unrest(2), one.unrest(3))
    ] == [[0.0, 0.0], [2.0, 1.0], [0.0, 0.0], [0.0, 0.0], [0.1, 0.15]]
    assert one.rise == 10.0
    assert one.still_rising == 0.0
    assert round(course([[-4.0, -3.0, -2.0, -1.0, 0.0]], [[1.0] * 5]).still_rising, 9) == 0.25


def test_printed_results__hybrid_avoids_more_than_its_parts_can() -> None:
    parts = [printed("hybrid test", agent) for agent in ("E-V2X-BM", "Standalone DRL", "Hybrid")]
    assert selection_verdict(*parts).outcome == "cannot agree"
    assert "so it avoids at most 737 + 1,263 = 2,000 collisions; printed: 2,005" in selection_verdict(*parts).because
    assert selection_verdict(*parts[:2], replace(parts[2], collisions=3_000)).outcome == "agrees"
    row, baseline = printed("random test", "Hybrid PPO"), printed("random test", "Non-E")
    assert decrease_verdict(row, baseline).outcome == "agrees"
    assert decrease_verdict(replace(row, harm_decrease=0.85), baseline).outcome == "cannot agree"


@pytest.mark.parametrize(
    ("outcomes", "expected"),
    [
        (("agrees", "agrees"), ("agrees", "of 2 comparisons 2 agree; w0: b0")),
        (("agrees", "differs"), ("differs", "of 2 comparisons 1 differs, 1 agrees; w1: b1")),
        (
            ("differs", "cannot agree", "agrees"),
            ("cannot agree", "of 3 comparisons 1 cannot agree, 1 differs, 1 agrees; w1: b1"),
        ),
        (("agrees", "not run"), ("not run", "of 2 comparisons 1 not run, 1 agrees; w1: b1")),
        (
            ("not run", "undecided", "agrees"),
            ("undecided", "of 3 comparisons 1 undecided, 1 not run, 1 agrees; w1: b1"),
        ),
        ((), ("not run", "nothing was compared")),
    ],
)
def test_verdicts__the_worst_is_told_and_counts(outcomes, expected) -> None:
    found = summarise_verdicts([Verdict(f"w{k}", outcome, f"b{k}") for k, outcome in enumerate(outcomes)])
    assert (found.outcome, found.because) == expected


def test_returns__of_a_shaped_reward_say_nothing_between_delays_so_its_harm_is_compared() -> None:
    worse = course([[-9.0] * 20, [-8.99] * 20], [[90.0] * 20, [80.0] * 20])
    better = course([[-10.0] * 20, [-9.99] * 20], [[10.0] * 20, [8.0] * 20])  # of lower returns
    for recipe, outcome, told in (("ppo", "agrees", "minus its harm"), ("ppo-paper", "differs", "ppo-paper")):
        assert bool(eb.load_recipe(recipe).reward.shaping) == (recipe == "ppo")
        verdict = delay_curves._higher_when_low({"high": {recipe: worse}, "low": {recipe: better}})
        assert (verdict.outcome, told in verdict.because) == (outcome, True)
