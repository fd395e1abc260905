"""The page of an evaluation: its first sentence, its worlds, its player, its tables."""

import json
import re
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import ethbrake_marl as eb
from ethbrake_marl.agent_names import teams_of
from ethbrake_marl.episode.counts import FIRST_IMPACTS, HONEST, HarmCount
from ethbrake_marl.evaluation.comparison import Comparison
from ethbrake_marl.evaluation.record import record_episodes
from ethbrake_marl.extensions.report.best_known import IMPACT_UNAVOIDABLE
from ethbrake_marl.extensions.report.episodes import (
    MOTION_SAMPLE_S,
    episode_data,
    episodes_section,
    pieces_of,
    replaced_at_s,
    shown_worlds,
    worst_rows,
)
from ethbrake_marl.extensions.report.report import (
    ReportPage,
    Test as OtherTest,
    agents_in_words,
    avoidable_section,
    first_sentence,
    short_table,
    worst_section,
)
from ethbrake_marl.extensions.report.run import learners_sheets
from ethbrake_marl.training.experiment import TEAM, without
from tests.evaluation.lines import recorded
from tests.extensions.report.conftest import AGENTS, compared_by, with_best_known
from tests.fixtures.page import HOSTILE, UNSEEN, Page

FOCUS = "constant:4.5"


def player_data(html: str) -> Any:
    (text,) = re.findall(r'<script type="application/json" id="episode_data">(.*?)</script>', html)
    return json.loads(text)


@pytest.fixture(scope="module")
def html(compared: Comparison) -> str:
    other = OtherTest("Another test.", compared_by("paper-random-obstacle", AGENTS, 30))
    settings = {"Training seed": 5, "Command": "ethbrake run"}
    return ReportPage(
        "A page", compared, "One million steps.", settings, tests={"Obstacle test": other}, remarks=["Stopped early."]
    ).html


# ---- the first sentence


def test_first_sentence__compares_with_full_braking() -> None:
    mine = with_best_known(compared_by("paper-random", "full_brake,ppo", 60, "total"))
    after, before = (mine.result[agent]["total_harm"].mean() for agent in ("ppo", "full_brake"))
    assert first_sentence(mine, "ppo", {}) == (
        f"ppo does {100 * (1 - after / before):.0f} % less harm than full braking (all impacts: {after:.2f} m²/s² per"
        f" emergency instead of {before:.2f}; best known {mine.result['ppo']['best_known_total'].mean():.2f})."
    )


def test_first_sentence__of_the_honest_cost() -> None:
    mine = with_best_known(compared_by("paper-random", "full_brake,ppo", 60, "honest"))
    after, before = (mine.result[agent]["honest_cost"].mean() for agent in ("ppo", "full_brake"))
    total, much = (mine.result[agent]["total_harm"].mean() for agent in ("ppo", "full_brake"))
    assert after > before + 20.0  # it pushes
    assert first_sentence(mine, "ppo", {}) == (
        f"ppo costs {100 * (after / before - 1):.0f} % more than full braking (honest cost: {after:.2f} m²/s² per"
        f" emergency instead of {before:.2f}; total harm: {total:.2f} instead of {much:.2f})."
    )
    assert first_sentence(mine, "full_brake", {}) == (
        f"Full braking costs {before:.2f} m²/s² per emergency (honest cost; total harm: {much:.2f})."
    )


def test_page__of_the_honest_cost_shows_it_beside_both_harms() -> None:
    page = Page(ReportPage("Mine", compared_by("paper-random", "full_brake,e_v2x_bm", 60, "honest"), "Short.", {}).html)
    assert "Honest cost of each agent" in page.text
    assert "First-impact harm Total harm Honest cost Push (m/s)" in page.text


def test_first_sentence__flatters_nobody(compared: Comparison) -> None:
    def about(agents: str, **changes: Any) -> str:
        loaded = eb.load_scenario("paper-random").replace(**changes)
        found = Comparison.of(loaded, teams_of(agents, loaded), harm_count="first", episodes=60, seed=7)
        return first_sentence(found, agents.rpartition(",")[2], {})

    assert " % more harm than full braking (" in about("full_brake,coast")
    equal = compared_by("paper-random", "full_brake,constant:6.5")
    said = first_sentence(equal, "constant:6.5", {"Other test": equal})
    assert said.startswith("constant:6.5 does about as much harm as full braking (")
    assert "), and as much in the other test (" in said
    alone = about("full_brake")
    assert alone.startswith("Full braking does ") and "instead of" not in alone and alone.endswith(").")
    far = {"gaps_m": {"uniform": [60.0, 70.0]}}
    assert about("full_brake,coast", **far).startswith("coast does more harm than full braking (")  # no share of 0
    other = compared_by("paper-random-obstacle", AGENTS, 200)
    said = first_sentence(compared, "ppo", {"Obstacle test": other})
    (row,) = (row for row in other.table if row.agent == "ppo")
    assert f"), but more in the obstacle test ({row['first_impact_harm'].value:.2f} instead of " in said


# ---- the worlds that are shown


def test_shown__begin_with_the_worst(compared: Comparison, searched: Comparison) -> None:
    harm, braking = (compared.result[agent]["first_impact_harm"] for agent in (FOCUS, "full_brake"))
    chosen = shown_worlds(compared, FOCUS)
    assert len(chosen) == 50 and len({*chosen.values()}) == 5
    assert harm[list(chosen)[:10]].tolist() == sorted(harm, reverse=True)[:10]
    for row, kind in chosen.items():
        saved = braking[row] - harm[row]
        assert saved > 0.0 if "saved most" in kind else saved < 0.0 if "did worse" in kind else True
    regret = harm - searched.result[FOCUS]["best_known_first"]
    assert regret[worst_rows(searched, FOCUS)].tolist() == sorted(regret, reverse=True)[:10]
    avoidable = [row for row, kind in shown_worlds(searched, FOCUS).items() if "avoidable" in kind]
    assert avoidable and (searched.result[FOCUS]["contact_avoidable"] & (harm > 0.0))[avoidable].all()


def test_worlds__are_ranked_by_what_the_agents_minimise(compared: Comparison, searched: Comparison) -> None:
    honest, cost = compared._replace(harm_count=HONEST), compared.result["ppo"]["honest_cost"]
    assert cost[worst_rows(honest, "ppo")].tolist() == sorted(cost, reverse=True)[:10]
    section = " ".join(map(str, worst_section(honest, "ppo", ()).body))
    assert "did worst, by honest cost." in section and section.count("Honest cost") == 1
    unknown = searched._replace(harm_count=HONEST)  # no best known honest cost
    assert worst_rows(unknown, "ppo") == worst_rows(honest, "ppo")
    section = " ".join(map(str, worst_section(unknown, "ppo", ()).body))
    assert "by honest cost." in section and section.count("Honest cost") == 1


def test_shown__are_different_worlds() -> None:
    """Twelve rows of a table, drawn many times: each is shown once."""
    columns = ["gap_1_m", "gap_2_m", "speed_2_mps"]
    rows = [[7.0 + k % 4, 6.0 + k / 3.0, 20.0 + k % 3] for k in range(12)]
    scenario = eb.load_scenario("paper-random").replace(table={"columns": columns, "rows": rows}, gaps_m=None)
    tabled = compared_by(scenario, AGENTS, 120)
    origins = tabled.result.worlds["same_row_as"]
    assert len({*origins.tolist()}) == 12
    for focus in AGENTS:
        worst, shown = worst_rows(tabled, focus), [*shown_worlds(tabled, focus)]
        assert len({*origins[worst].tolist()}) == len(worst) == min(10, len(worst))
        assert {*origins[shown].tolist()} == {*origins.tolist()} and len(shown) == 12 and shown[: len(worst)] == worst
    text = str(worst_section(tabled, FOCUS, ()).body[1])
    assert text.count("<tr") == len(worst_rows(tabled, FOCUS)) + 1
    assert "95 % intervals by 12 different rows of the table" in ReportPage("A page", tabled, "x", {}).html


@pytest.mark.parametrize(("count", "known"), [("total", True), ("honest", False)])
def test_worlds__to_watch_are_those_of_the_cost_that_the_agents_minimise(
    count: str, known: bool, compared: Comparison, searched: Comparison
) -> None:
    """They are the worlds of the first-impact harm if this had the values of the cost."""
    mine = (searched if known else compared)._replace(harm_count=HarmCount.of(count))
    renamed = {
        agent: {
            **own,
            "first_impact_harm": own[HarmCount.of(count).column],
            "best_known_first": own.get(f"best_known_{count}", 0.0),
        }
        for agent, own in mine.result.columns.items()
    }
    other = mine._replace(result=replace(mine.result, columns=renamed), harm_count=FIRST_IMPACTS)
    for focus in ("ppo", FOCUS, "full_brake"):
        chosen = shown_worlds(mine, focus)
        assert chosen == shown_worlds(other, focus)
        assert chosen != shown_worlds(mine._replace(harm_count=FIRST_IMPACTS), focus)


def test_worst_worlds__can_be_watched(searched: Comparison) -> None:
    shown = worst_rows(searched, FOCUS)[:3]
    text = str(worst_section(searched, FOCUS, shown).body[1])
    assert text.count("data-watch") == 3 and text.count("avoidable") == 10
    assert f'data-watch="{shown[0]}"' in text and f"{searched.result[FOCUS]['total_harm'][shown[0]]:.2f}" in text


def test_unavoidable__splits_the_worlds_only_if_somebody_has_proven_it(
    compared: Comparison, searched: Comparison
) -> None:
    never = searched.result[FOCUS][IMPACT_UNAVOIDABLE]
    section = avoidable_section(searched)
    text = " ".join(map(str, section.body))
    assert section.title == "What was avoidable" and f"{100 * never.mean():.1f} %" in text
    assert f"Impact unavoidable: {never.sum()} worlds" in text
    harm = searched.result[FOCUS]["first_impact_harm"] - searched.result[FOCUS]["best_known_first"]
    hard, _, easy = text.partition("Other worlds")
    assert f"<td>{harm[never].mean():.2f} " in hard and f"<td>{harm[~never].mean():.2f} " in easy
    section = avoidable_section(compared)
    assert section.title == "World by world" and len(section.body) == 1


def test_tables__have_no_interval_that_takes_worlds_of_a_recording_for_independent() -> None:
    agents = {TEAM: "constant:4.5", without("vehicle_2"): "coast", without("vehicle_3"): "full_brake"}
    mine = with_best_known(compared_by(recorded(8).with_learners(["vehicle_2", "vehicle_3"]), agents))
    result = mine.result
    never = result.worlds["gap_1_m"] + result.worlds["gap_2_m"] <= 15.0
    columns = {agent: {**own, IMPACT_UNAVOIDABLE: never} for agent, own in result.columns.items()}
    apart = {**result.worlds, "recording": np.arange(result.n).astype(str)}
    intervals = []
    for worlds in (result.worlds, apart):
        one = mine._replace(result=replace(result, columns=columns, worlds=worlds))
        shown = re.findall(r"\[[-\d., ]+\]", " ".join(map(str, avoidable_section(one).body[:3])))
        estimates = [each for sheet in learners_sheets(one) for row in sheet.rows for each in row[1:]]
        intervals.append([*shown, *(each.interval for each in estimates)])
    same = [pair for pair in zip(*intervals, strict=True) if pair[0] == pair[1]]
    assert same == [] and len(intervals[0]) > 40


# ---- the player


def test_page__shows_fifty_worlds_whose_counts_are_those_of_the_evaluation(html: str, compared: Comparison) -> None:
    content = player_data(html)
    assert content["agents"] == [*AGENTS] and len(content["worlds"]) == 50 and content["shown"] == [0, 2, 3]
    for world in content["worlds"]:
        k = compared.result.worlds["world"].tolist().index(world["number"])
        for agent, episode in zip(content["agents"], world["episodes"], strict=True):
            own = compared.result[agent]
            said = episode["impacts"][-1][4:] if episode["impacts"] else [0, 0.0, 0.0]
            assert said == [own["impacts"][k], own["first_impact_harm"][k], own["total_harm"][k]]
            assert episode["end"] == own["end_s"][k] and episode["driven"] == [1]
    assert world["value"] == compared.result["ppo+episode"]["first_impact_harm"][k]
    assert "World: first-impact harm of ppo+episode (m²/s²)" in html


def at(pieces: Any, time_s: float, vehicles: int) -> Any:
    """Place of Vehicle 1, gaps and speeds, as the script of the player computes them."""
    piece = pieces[max(int(np.searchsorted(pieces[:, 0], time_s, "right")) - 1, 0)]
    speeds, rates, t = piece[1 + vehicles : 1 + 2 * vehicles], piece[1 + 2 * vehicles :], time_s - piece[0]
    ways = (speeds + 0.5 * rates * t) * t
    return np.concatenate([[piece[1] + ways[0]], piece[2 : 1 + vehicles] + ways[:-1] - ways[1:], speeds + rates * t])


@pytest.mark.parametrize("name", ["cooperation-4-all"])
def test_pieces__are_the_motion_of_the_episode(name: str) -> None:
    scenario, game = eb.open_game(name)
    (team,) = teams_of("constant:3", scenario).values()
    worlds = scenario.sample(4, 7)
    for record, fine in zip(
        *(record_episodes(worlds, team, game, step) for step in (MOTION_SAMPLE_S, 1e-3)), strict=True
    ):
        pieces, N = pieces_of(record), scenario.vehicles
        assert len(pieces) < 0.3 * len(record.time_s)
        near = np.abs(fine.time_s[:, np.newaxis] - record.impacts.time_s).min(axis=1, initial=1.0) < 0.01
        for k in range(0, len(fine.time_s), 3):
            now = at(pieces, fine.time_s[k], N)
            right = [fine.positions_m[k, 0], *fine.gaps_m[k], *fine.speeds_mps[k]]
            assert now[:N] == pytest.approx(right[:N], abs=5e-3 if near[k] else 1e-4)


def test_player__marks_the_decisions_that_a_shield_replaced() -> None:
    scenario, game = eb.open_game("paper-random")
    (team,) = teams_of("coast+step", scenario).values()
    (record,) = record_episodes(scenario.sample(1, 7), team, game)
    replaced = record.last.memories["shield"].replaced[0]
    times = replaced_at_s(record)
    decisions = [float(state.time_s[0]) for state in record.states[1:-1]]
    assert len(times) == replaced > 0 and {*times} <= {*decisions} and times[0] == decisions[0] == 0.5
    assert episode_data(record)["stepped"] == times


def test_episodes__are_compared_with_the_evaluation_in_both_counts(compared: Comparison) -> None:
    columns = {
        agent: {name: values.copy() for name, values in own.items()} for agent, own in compared.result.columns.items()
    }
    columns["ppo"]["total_harm"][3] += 1.0
    columns["ppo"]["first_impact_harm"][5] += 1.0
    changed = compared._replace(result=replace(compared.result, columns=columns))
    text = " ".join(map(str, episodes_section(changed, "ppo", dict.fromkeys([3, 5, 7], "shown")).body))
    assert "In 2 worlds of these, ppo drove differently" in text and text.count("drove differently") == 1


# ---- the whole page


EXTERNAL = re.compile(r"""(https?:)?//|@import|<(link|iframe|object|embed|base)\b""", re.IGNORECASE)


def test_page__holds_everything_that_it_was_given_and_loads_nothing(html: str, compared: Comparison) -> None:
    page = Page(html)
    for word in ("One million steps.", "Stopped early.", "Training seed 5", compared.table.parameters["worlds_sha256"]):
        assert word in page.text
    for row in compared.table:
        assert row["total_harm"].in_words() in re.sub(r" (?=\[)", " ", page.text)
    assert "ppo+episode does" in page.text  # the last one with a policy
    own = re.sub(r"(?m)//.*$|<script type=.*</script>", "", html)  # without comments of scripts, numbers of episodes,
    assert EXTERNAL.search(re.sub(r'xmlns(:\w+)?="[^"]*"|"http://www.w3.org/2000/svg"', "", own)) is None  # and names
    for _, attributes in page.tags:
        assert (attributes.get("href") or "#").startswith("#")
        assert attributes.get("src", "data:").startswith("data:")


def test_page__hostile_names_are_text_everywhere() -> None:
    names = [text[:200] for text in HOSTILE]
    agents = {name: "constant:4" for name in names if name.isprintable()}  # others are refused
    found, words = compared_by("paper-random", agents, 3), " ".join(names)
    html = ReportPage(words, found, words, {name: name for name in names}, focus=next(iter(agents))).html
    page = Page(html)
    assert page.open == [] and not set(html) & UNSEEN and html.count("<script") == 2
    assert not any(key.startswith("on") for _, attributes in page.tags for key in attributes)
    assert [len(world["episodes"]) for world in player_data(html)["worlds"]] == [len(agents)] * 3


def test_first_table__begins_with_the_count_that_agents_minimise() -> None:
    for count, words in (("honest", "Honest cost"), ("total", "Total harm")):
        text = str(short_table(compared_by("paper-random", "full_brake,coast", 20, count).table, HarmCount.of(count)))
        assert re.findall(r'<th scope="col">([^<]+)</th>', text)[:2] == ["Agent", words]


def test_agents_in_words__name_every_agent_of_this_package() -> None:
    words = agents_in_words(["e_v2x_bm:pairwise", "ppo@runs/x+step", "mine", "hybrid", "./mine.py:make"])
    assert [*words] == ["e_v2x_bm:pairwise", "ppo@runs/x+step", "hybrid"]
    assert "closed form" in words["e_v2x_bm:pairwise"] and words["ppo@runs/x+step"].endswith("certified, or replaced")
