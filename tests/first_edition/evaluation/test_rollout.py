"""Rollouts and whole lists, by hand and chunk by chunk: the same bits for any chunks and processes."""

import warnings
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import fields, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any
from unittest.mock import Mock, call

import numpy as np
import pytest

import ethbrake_marl.first_edition as eb
from ethbrake_marl import registry
from ethbrake_marl.errors import InvalidInput, PhysicsError, Unfamiliar
from ethbrake_marl.files import python_file
from ethbrake_marl.first_edition.agents.protocol import policy_sha256
from ethbrake_marl.first_edition.evaluation import chunks, identity
from ethbrake_marl.first_edition.evaluation.aftermath import ShovedFront
from ethbrake_marl.first_edition.evaluation.chunks import Lineup, evaluate_held, summarise_tally, tally_list
from ethbrake_marl.first_edition.evaluation.evaluation import Evaluation
from ethbrake_marl.first_edition.evaluation.identity import scenario_sha256, worlds_sha256
from ethbrake_marl.first_edition.evaluation.lineup import make_agents, make_lineup
from ethbrake_marl.first_edition.evaluation.measure_sets import measures
from ethbrake_marl.first_edition.evaluation.outcome import Outcome
from ethbrake_marl.first_edition.evaluation.rollout import evaluate
from ethbrake_marl.first_edition.evaluation.summary import summarise
from ethbrake_marl.first_edition.evaluation.tally import Tally
from ethbrake_marl.first_edition.physics.paper_map import advance_sampled
from ethbrake_marl.first_edition.physics.state import Bools, Floats, Ints, Worlds
from ethbrake_marl.first_edition.scenario.catalogue import load_scenario
from ethbrake_marl.first_edition.scenario.schema import Scenario
from ethbrake_marl.first_edition.scenario.task import Task
from tests.first_edition.rest.failing_worlds import planted_list, without

BRAKE = {"full_brake": eb.make_agent("full_brake")}
PAPER = load_scenario("paper-random")
ROLES = {"vehicle_1": "full_brake", "vehicle_2": "learner", "vehicle_3": "full_brake"}


def arrays(outcome: Outcome) -> dict[str, np.ndarray]:
    """Every number of an outcome."""
    found = {f"ledger.{f.name}": getattr(outcome.ledger, f.name) for f in fields(outcome.ledger)}
    found |= {f"final.{name}": getattr(outcome.final, name) for name in ("gaps_m", "speeds_mps", "time_s", "pair_hit")}
    names = ("at_rest", "predicted_harm", "chosen_policy", "shoved_m", "sampled_harm")
    return found | {name: getattr(outcome, name) for name in names}


def assert_same(one: Outcome, other: Outcome, rows: Any = slice(None)) -> None:
    expected = arrays(other)
    for name, array in arrays(one).items():
        given = expected[name] if expected[name] is None else expected[name][rows]
        np.testing.assert_array_equal(array, given, err_msg=name, strict=True)


def test_evaluate__one_impact_by_hand(pair: Scenario) -> None:
    outcome = evaluate(pair.sample(2, 0), BRAKE, scenario=pair).outcome("full_brake")
    expected = {"collided": True, "impacts": 1, "first_impact_harm": 9.0, "total_harm": 9.0, "ended": "at_rest"}
    assert {name: getattr(outcome, name).tolist() for name in expected} == {
        name: [value if isinstance(value, str) else pytest.approx(value, rel=1e-12)] * 2
        for name, value in expected.items()
    }
    np.testing.assert_allclose(outcome.vehicle_harm("first"), [[4.95, 4.05]] * 2, rtol=1e-12)
    np.testing.assert_allclose(outcome.final.gaps_m, 0.90825, rtol=1e-12)
    np.testing.assert_allclose(outcome.final.time_s, 3.7, rtol=1e-12)  # the step in which the line came to rest
    assert outcome.final.speeds_mps.tolist() == [[0.0, 0.0]] * 2
    assert outcome.predicted_harm is outcome.chosen_policy is None


def test_evaluate__full_braking_on_the_papers_random_test() -> None:
    # Two independent programs, 20,000 worlds: 85.6 %, 24.0, 25.6. Allowed: three standard errors at 2,000.
    outcome = evaluate(PAPER.sample(2000, 7), BRAKE, scenario=PAPER, aftermath=False).outcome("full_brake")
    assert outcome.collided.mean() == pytest.approx(0.856, abs=0.024)
    assert outcome.first_impact_harm.mean() == pytest.approx(24.0, abs=1.2)
    assert outcome.total_harm.mean() == pytest.approx(25.6, abs=1.3)
    assert outcome.at_rest.all()


@pytest.mark.parametrize(("chunk", "n"), [(1, 12), (7, 200), (199, 200)])
def test_evaluate__does_not_depend_on_the_chunk_nor_on_the_worlds_behind(
    evaluation: Evaluation, gap_agent: Any, chunk: int, n: int
) -> None:
    rows, agents = np.arange(n), {"gap": gap_agent, "constant:4.5": eb.make_agent("constant:4.5")}
    seen: list[tuple[str, int]] = []
    chunked = evaluate(
        evaluation.worlds.take(rows), agents, scenario=evaluation.scenario, chunk=chunk,
        on_progress=lambda *done: seen.append(done),
    )  # fmt: skip
    assert chunked.outcome("gap").collided.any()
    for name in agents:
        assert_same(chunked.outcome(name), evaluation.outcome(name), rows)
    assert seen == [(name, end) for end in [*range(chunk, n, chunk), n] for name in agents]


def test_evaluate__an_episode_that_the_horizon_cuts_is_reported_so(pair: Scenario) -> None:
    short = pair.replace(horizon_s=1.0)
    outcome = evaluate(short.sample(1, 0), BRAKE, scenario=short).outcome("full_brake")
    assert (outcome.ended.tolist(), outcome.final.time_s.tolist()) == (["horizon"], [1.0])
    assert (outcome.final.speeds_mps > 0.0).all()


@pytest.mark.parametrize("named", [{"vehicle": 2}, {"vehicle": "vehicle_3"}, {}])
def test_evaluate__drives_the_vehicle_that_is_named(named: dict[str, Any]) -> None:
    third = PAPER.with_learners(["vehicle_3"])
    result = evaluate(PAPER.sample(5, 0), {"coast": eb.make_agent("coast")}, scenario=third, **named)
    commands = result.outcome("coast").final.command_mps2
    assert result.vehicle == 2 and (commands[:, 2] == 0.0).all() and (commands[:, 1] == -7.0).all()


# ---------------------------------------------------------------- how far Vehicle 1 is shoved, and the sum over samples

# Two vehicles at rest and in touch; the rear one pushes with 5.5 t x 6 m/s2 = 33 kN against brakes of 27 kN, plastic.
# Together they gain 6 kN / 10 t = 0.6 m/s2: after 2 s they stand 1.2 m further on. In each step of the sampled map the
# pusher gains at most 1.2 m/s on the pushed: w = 0, 0.6, 0.93, 1.1115, then 1.2 at 16 samples.
PUSH = Scenario(
    name="push", vehicles=2, gaps_m=0.0, speeds_mps=0.0, braking_capacity_mps2=6.0, driving_capacity_mps2=6.0,
    mass_t=[4.5, 5.5], latency_s=0.0, restitution=0.0, horizon_s=2.0, roles={"vehicle_2": "learner"},
)  # fmt: skip
PUSHED_SAMPLES = 0.6**2 + 0.93**2 + 1.1115**2 + 16 * 1.2**2
PAIR = PUSH.replace(  # see PAIR of the fixtures: speed 20 - 6 t before the impact, 18.315 m/s after it; 3 m/s at 0.6 s
    gaps_m=1.0, speeds_mps=20.0, latency_s=[0.0, 0.5], restitution=0.1, horizon_s=8.0
)
IMPACT_S = 0.5 + 0.25 / 3.0
PAIR_SHOVED = 20.0 * IMPACT_S - 3.0 * IMPACT_S**2 + 18.315**2 / 12.0 - 20.0**2 / 12.0


@pytest.mark.parametrize(
    ("scenario", "spec", "shoved", "sampled"),
    [
        (PAIR, "full_brake", PAIR_SHOVED, 9.0),
        (PUSH, "constant:-6", 1.2, PUSHED_SAMPLES),
        (PUSH.replace(obstacle_gap_m=0.5, horizon_s=8.0), "constant:-6", 0.5, None),
        (PUSH.replace(obstacle_gap_m=9.0).with_learners(["vehicle_1"]), "full_brake", None, None),
        *(
            (PUSH.replace(gaps_m=500.0, speeds_mps=[20.0, 10.0], roles={"vehicle_1": script, "vehicle_2": "learner"}),
             "full_brake", 0.0, 0.0)
            for script in ("full_brake", "coast", "constant:2.5", "constant:-1")
        ),
    ],
)  # fmt: skip
def test_aftermath__by_hand(scenario: Scenario, spec: str, shoved: float | None, sampled: float | None) -> None:
    result = evaluate(scenario.sample(1, 7), {spec: eb.make_agent(spec)}, scenario=scenario, seed=7)
    outcome = result.outcome(spec)
    for found, expected in ((outcome.shoved_m, shoved), (outcome.sampled_harm, sampled)):
        assert found is None if expected is None else found == pytest.approx([expected], abs=1e-9)
    told = summarise(result)[0].to_json()
    assert (told["vehicle_1_shoved_m"] is None, told["sampled_harm"] is None) == (shoved is None, sampled is None)


@pytest.mark.parametrize(("spec", "command"), [("full_brake", -7.0), ("constant:4.5", -4.5)])
def test_sampled__of_a_constant_is_that_of_the_map(evaluation: Evaluation, spec: str, command: float) -> None:
    commands = -evaluation.worlds.vehicles.braking_capacity_mps2
    commands[:, 1] = command
    _, impacts = advance_sampled(evaluation.worlds, commands, until_s=8.0, step_s=0.1)
    np.testing.assert_allclose(evaluation.outcome(spec).sampled_harm, impacts.total_harm.sum(axis=1), atol=1e-9)


def test_aftermath__can_be_left_out_and_changes_no_result(evaluation: Evaluation, gap_agent: Any) -> None:
    given = {"scenario": evaluation.scenario, "aftermath": False}
    outcome = evaluate(evaluation.worlds, {"gap": gap_agent}, **given).outcome("gap")
    assert_same(outcome, replace(evaluation.outcome("gap"), shoved_m=None, sampled_harm=None))


# ---------------------------------------------------------------- worlds that the physics cannot advance

N, PLANTED, SEED = 12, [3, 7], 7
HARD = 8.5  # gap (m) of the world in which ``Failing`` fails


class Failing:
    """Brakes fully; in one world, known by a gap of its own, it meets a defect of the physics at its third decision."""

    name = "failing"

    def begin(self, alert: Worlds, vehicle: int, scripts: object) -> tuple[Bools, Ints]:
        return alert.gaps_m[:, 1] == HARD, np.zeros(alert.n, np.int64)

    def act(self, worlds: Worlds, memory: tuple[Bools, Ints], vehicle: int) -> tuple[Floats, tuple[Bools, Ints]]:
        hard, decisions = memory
        if (wrong := np.flatnonzero(hard & (decisions == 2))).size:
            raise PhysicsError({int(row): "planted" for row in wrong})
        return -worlds.vehicles.braking_capacity_mps2[:, vehicle], (hard, decisions + 1)


def left_out_by(*specs: str) -> Evaluation:
    """Of full braking, these agents and a failing one."""
    sample = planted_list(PAPER, N, SEED, PLANTED)
    sample.worlds.gaps_m[10, 1] = HARD
    agents = {**make_agents(("full_brake", "e_v2x_bm", *specs), PAPER), "failing": Failing()}
    return evaluate(sample, agents, scenario=PAPER, seed=SEED, chunk=5)


@pytest.fixture(scope="module")
def found() -> Evaluation:
    return left_out_by("e_v2x_bm:pairwise", "coast")


def test_left_out__worlds_are_named_and_left_out_for_all_agents(found: Evaluation) -> None:
    check_left_out(found)


def check_left_out(found: Evaluation) -> None:
    told = [(left.world, left.seed, left.agent) for left in found.left_out]
    assert told == [(3, SEED, "full_brake"), (7, SEED, "full_brake"), (10, SEED, "failing")]
    assert "a contact was missed between 0 s and 0.5 s" in found.left_out[0].reason
    assert found.index.tolist() == without(N, [3, 7, 10]).tolist()
    sizes = {(len(each.collided), each.final.n, np.isfinite(each.total_harm).sum()) for each in found.outcomes.values()}
    assert sizes == {(9, 9, 9)} and found.worlds.n == 9
    with pytest.raises(PhysicsError, match=r"world 3: full_brake: a contact was missed.*world 10: failing: planted"):
        found.complete()
    with pytest.raises(PhysicsError, match="world 0: full_brake: a contact was missed"):
        evaluate(planted_list(PAPER, 2, SEED, [0, 1]), BRAKE, scenario=PAPER)  # nothing is left


# ---------------------------------------------------------------- by which hashes a result is recognised

SAMPLE = PAPER.sample(60, seed=7)


def test_worlds_sha256__tells_every_bit_and_not_how_it_lies_in_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    worlds, index = SAMPLE.worlds, SAMPLE.index
    own = worlds_sha256(worlds, index)
    others = [
        (replace(worlds, gaps_m=np.nextafter(worlds.gaps_m, 0.0)), index),
        (replace(worlds, vehicles=replace(worlds.vehicles, mass_t=2.0 * worlds.vehicles.mass_t)), index),
        (worlds, index + 1),
        (worlds.take(np.arange(59)), index[:59]),
        (PAPER.sample(60, 8).worlds, index),
    ]
    assert len({own, *(worlds_sha256(*each) for each in others)}) == 6
    copied = worlds.take(np.arange(60))  # the news of a world is a view there, an array of its own here
    monkeypatch.setattr("ethbrake_marl.first_edition.evaluation.identity._BLOCK", 7)
    assert worlds_sha256(replace(copied, gaps_m=np.asfortranarray(copied.gaps_m)), index) == own


@pytest.mark.parametrize(
    ("spec", "policy"), [("ppo", "ppo"), ("ppo+episode", "ppo"), ("ppo+step", "ppo"), ("full_brake+step", None)]
)
def test_policy_sha256__is_found_inside_what_is_around_it(spec: str, policy: str | None) -> None:
    expected = policy and eb.load_shipped(policy).manifest.manifest_sha256
    assert policy_sha256(eb.make_agent(spec, scenario=PAPER)) == expected


def test_results__say_worlds_scenario_policy_and_versions() -> None:
    agents = {**BRAKE, "ppo": eb.make_agent("ppo", scenario=PAPER)}
    result = evaluate(SAMPLE, agents, scenario=PAPER, seed=7, chunk=25, aftermath=False)
    braking, learned = (row.to_json() for row in summarise(result))
    assert {key: learned[key] for key in ABOUT} == {key: braking[key] for key in ABOUT} == ABOUT
    policies = {"vehicle_2": eb.load_shipped("ppo").manifest.manifest_sha256}
    assert (braking["policy_sha256"], learned["policy_sha256"]) == ({}, policies)
    assert learned["versions"] == {
        name: learned["versions"]["python"] if name == "python" else version(name)
        for name in ("python", "ethbrake-marl", "numpy", "numba")
    }
    assert result.outcome("ppo").take(np.array([0])).policies == result.outcome("ppo").policies


ABOUT = {"worlds_sha256": worlds_sha256(SAMPLE.worlds, SAMPLE.index), "scenario_sha256": scenario_sha256(PAPER)}


@pytest.mark.parametrize(
    ("agent", "scenario", "beyond"),
    [
        ("ppo+step", load_scenario("paper-random-obstacle"), "obstacle_gap_m"),
        ("ppo", PAPER.replace(time_step_s=0.05), "time_step_s"),
        ("ppo", PAPER.replace(roles={**ROLES, "vehicle_3": "coast"}), "vehicle_3 by coast"),
        ("ppo", PAPER.replace(latency_s=[0.0, 0.5, 1.2]), "latency_s in 100 % of the worlds"),
        ("ppo", PAPER.replace(speeds_mps={"uniform": [18.0, 30.0]}), "speeds_mps in 9. % of the worlds"),
        ("ppo", load_scenario("cooperation-4-five"), "vehicle_1, .*, vehicle_5, 5 vehicles"),
        (
            "ppo",
            PAPER.replace(v2x={"tells": {"vehicle_3": ["place", "speed", "intent"]}}),
            "messages without acceleration, .*, messages without mass, messages with intent",
        ),
    ],
)
def test_policy__that_drives_beyond_what_it_was_trained_for_is_told_so_once(agent, scenario, beyond) -> None:
    check_beyond(agent, scenario, beyond)


def check_beyond(agent: str, scenario: Scenario, beyond: str) -> None:
    with pytest.warns(
        Unfamiliar, match=f"{agent.partition('+')[0]}.*, but {scenario.name} differs from it: {beyond}$"
    ) as told:
        evaluate(None, [agent], scenario=scenario, episodes=50, vehicle=None)
    assert len(told) == 1


def test_policy__that_drives_where_it_was_trained_is_not_warned_of() -> None:
    with warnings.catch_warnings(action="error"):
        evaluate(None, "universal,ppo", scenario=PAPER, episodes=200)
        for name in ("stress-wide", "paper-random-obstacle"):
            evaluate(None, "universal", scenario=name, episodes=200)
        evaluate(None, "vine-pair", scenario="cooperation-3-pair", episodes=100)


# ---------------------------------------------------------------- a list chunk by chunk


AGENTS = ("full_brake", "e_v2x_bm:pairwise")
LISTED = 3_300

FAILING = """
import numpy as np
from ethbrake_marl.errors import PhysicsError

class Failing:
    name, knows = "failing", "own sensors"

    def __init__(self, below):
        self.below = below

    def begin(self, alert, vehicle, scripts):
        return alert.gaps_m[:, 0] < self.below

    def act(self, worlds, memory, vehicle):
        if memory.any():
            raise PhysicsError({int(row): "planted" for row in np.flatnonzero(memory)})
        return -worlds.vehicles.braking_capacity_mps2[:, vehicle], memory

def make(argument, settings):
    return Failing(float(argument))
"""


@pytest.fixture(scope="module")
def lineup(paper_random: Scenario) -> Lineup:
    return Lineup.of(AGENTS, paper_random)


@pytest.fixture(scope="module")
def tally(lineup: Lineup) -> Tally:
    return tally_list(lineup, LISTED, 11, objectives=("own",))


@pytest.mark.parametrize("size", [5_000, 1_000, 777])
def test_tally__is_the_same_bits_for_any_chunks(lineup: Lineup, tally: Tally, size: int, monkeypatch) -> None:
    monkeypatch.setattr(chunks, "CHUNK", size)
    found = tally_list(lineup, LISTED, 11, objectives=("own",))
    assert replace(found, worlds_hash=0) == replace(tally, worlds_hash=0)


@pytest.mark.slow
def test_figures__are_the_same_bits_from_two_processes(paper_random: Scenario) -> None:
    lineup, told = Lineup.of(("full_brake", "e_v2x_bm"), paper_random), Mock()
    assert tally_list(lineup, 6_000, 5, jobs=2, on_done=told) == tally_list(lineup, 6_000, 5)
    assert told.call_args_list == [call(2_500), call(5_000), call(6_000)]
    sample = paper_random.sample(6_000, 5)
    one, two = (summarise(evaluate_held(lineup, sample, 5, jobs=jobs)) for jobs in (1, 2))
    assert one == two


@pytest.mark.parametrize("other", ["", "version", "package", "file"])
def test_worker__needs_the_packages_and_files_of_the_process_that_asks_and_no_others(
    paper_random: Scenario, failing: Callable[[float], str], tmp_path: Path, monkeypatch, other: str
) -> None:
    """As where that process loaded them for a role, a command or an evaluation before."""
    used = {"": {"numpy": np.__version__}, "version": {"numpy": "0.1"}, "package": {"none-such": "1"}}.get(other, {})
    monkeypatch.setattr(registry, "_VERSIONS", used)
    monkeypatch.setattr(python_file, "_RUN", {})
    make_lineup([failing(9.0)], paper_random)
    lineup = Lineup.of((failing(9.0) if other == "file" else "full_brake",), paper_random)
    monkeypatch.setattr(registry, "_VERSIONS", {})
    monkeypatch.setattr(python_file, "_RUN", {})
    monkeypatch.setattr(chunks, "_BUILT", {})
    (tmp_path / "failing.py").write_text(f"{FAILING}# changed")
    with pytest.raises(InvalidInput, match="a worker process has other policies") if other else nullcontext():
        lineup.make()


@pytest.mark.usefixtures("core_alone")
def test_figures__of_a_list_that_is_not_held_are_those_of_evaluate(monkeypatch) -> None:
    for one, other in in_both_ways(Lineup.of(AGENTS, PAPER), monkeypatch):
        assert all(one[measure.name] == other[measure.name] for measure in measures())
        assert one.to_json() == other.to_json()


def in_both_ways(lineup: Lineup, monkeypatch: pytest.MonkeyPatch) -> list[tuple[Any, Any]]:
    """The rows of each agent where the list is not held, and of ``evaluate``; ``HELD`` is lowered for their hash."""
    tally = tally_list(lineup, LISTED, 11, objectives=("own",))
    monkeypatch.setattr(identity, "HELD", LISTED - 1)
    evaluation = evaluate(PAPER.sample(LISTED, 11), lineup.make(), scenario=PAPER, seed=11, chunk=777)
    assert tally.rescore(["own"], 3) == evaluation.rescore(["own"])
    return [*zip(summarise_tally(lineup, tally, 11), summarise(evaluation), strict=True)]


@pytest.fixture
def failing(tmp_path: Path) -> Callable[[float], str]:
    """An agent that fails in worlds with a first gap below this."""
    file = tmp_path / "failing.py"
    file.write_text(FAILING)
    return lambda below: f"{file}:make:{below}"


# ---------------------------------------------------------------- recorded before search and loop were made faster


def test_aftermath__has_no_meaning_where_vehicle_1_reacts_or_another_than_vehicle_2_is_driven() -> None:
    reacts = PUSH.replace(roles={"vehicle_1": "ppo", "vehicle_2": "learner"})
    assert ShovedFront.of(reacts.sample(1, 7).worlds, Task(reacts, (1,))) is None
    third = PAPER.with_learners(["vehicle_3"])
    assert evaluate(third.sample(1, 7), BRAKE, scenario=third).outcome("full_brake").sampled_harm is None


COAST = eb.make_agent("coast")


def test_commands__are_applied_unrounded() -> None:
    # -3.52 / 7 * 7 is not -3.52 in floating point: a way through the action would show.
    one = eb.evaluate(PAPER.sample(1, 0), {"c": eb.make_agent("constant:3.52")}, scenario=PAPER).outcome("c")
    assert float(one.final.command_mps2[0, 1]) == -3.52


def test_evaluation__notes_the_place_of_each_world_in_its_list() -> None:
    sample = PAPER.sample(4, 7, first=10)
    assert [
        eb.evaluate(given, {"coast": COAST}, scenario=PAPER).index.tolist() for given in (sample, sample.worlds)
    ] == [[10, 11, 12, 13], [0, 1, 2, 3]]


@pytest.mark.parametrize(
    ("shield", "expected"),
    [("episode", ("HybridAgent", "coupled", "total")), ("episode:pairwise", ("HybridAgent", "pairwise", "total"))],
)
def test_lineup__of_a_hybrid_has_the_bound_and_the_count_that_were_asked(shield, expected) -> None:
    (agent,) = make_lineup([f"ppo+{shield}"], PAPER, harm_count="total").values()
    assert (type(agent).__name__, agent.bound, agent.harm_count) == expected


@pytest.mark.usefixtures("core_alone")
def test_lineup__keeps_order_and_specs_and_the_ladder_is_every_rung() -> None:
    assert list(make_lineup(["ladder", "constant:5"], PAPER)) == [
        "coast",
        "full_brake",
        "e_v2x_bm:pairwise",
        "e_v2x_bm",
        "constant:5",
    ]
