"""Worlds that depart from the plain game are refused by everything that predicts the plain game.

The departure is planted in the physics. What predicts is found by importing the package (``tests/reach.py``).
"""

from __future__ import annotations

import re
from typing import Any

import numpy as np
import pytest

import ethbrake_marl as eb
from ethbrake_marl.agent_names import AGENTS, WRAPPERS, make_teams
from ethbrake_marl.episode import departures
from ethbrake_marl.episode.departures import departures_of
from ethbrake_marl.episode.features import GROUPS
from ethbrake_marl.episode.game import Game
from ethbrake_marl.episode.state import State, mark, require
from ethbrake_marl.errors import EthBrakeError, InvalidInput, MissingExtra
from ethbrake_marl.evaluation.evaluate import evaluate_teams
from ethbrake_marl.evaluation.measure_registry import MEASURES
from ethbrake_marl.motion.layout import BRAKE_RATE, GAP, LATENCY, SPEED
from ethbrake_marl.worlds.channel import CHANNEL_KEYS
from ethbrake_marl.worlds.physics import PHYSICS, register_physics
from tests import reach
from tests.refused import refused

PAPER = eb.load_scenario("paper-random")


class Ice:
    """From 0.6 s to 1.6 s after the alert, no brake has an effect."""

    def check(self, scenario: Any) -> None:
        pass

    def rewarding(self, game: Game) -> Any:
        return game.rewarding

    def first_decision(self, game: Game, alert: State) -> State:
        return game._replace(physics=None).first_decision(alert)

    def follow(self, game: Game, state: State, actions: Any) -> Any:
        car = state.car.copy()
        car[(state.time_s >= 0.6) & (state.time_s < 1.6), LATENCY] = np.inf
        after, step = game._replace(physics=None).follow(state._replace(car=car), actions)
        return after._replace(car=state.car), step


class Exact(Ice):
    departures = frozenset[str]()

    def follow(self, game: Game, state: State, actions: Any) -> Any:
        return game._replace(physics=None).follow(state, actions)


class Named(Ice):
    departures = frozenset({"black ice"})


@pytest.fixture
def icy() -> eb.Scenario:
    register_physics("ice", Ice())
    return PAPER.replace(physics="ice")


def of_form(form: str) -> set[str]:
    """Names of a form, such as ``e_v2x_bm`` and ``e_v2x_bm:pairwise`` of ``e_v2x_bm[:pairwise]``."""
    form = re.sub(
        ":A$", ":3", form.replace("CANDIDATES", "20").replace("INTERVALS", "gaps_m=0.5").replace("PHASES", "2")
    )
    return {re.sub(r"\[.*?\]", "", form), form.replace("[", "").replace("]", "")}


def specs() -> list[str]:
    """All registered agents and shields that need no file of the user."""
    agents = [spec for name in AGENTS if callable(AGENTS[name].make) for spec in of_form(AGENTS[name].form)]
    wrapped = [f"coast+{spec}" for name in WRAPPERS for spec in of_form(WRAPPERS[name].form)]
    return sorted({spec for spec in agents + wrapped if "@" not in spec})


def measure_names() -> list[str]:
    return sorted(name for entry in MEASURES for name in MEASURES.load(entry))


def answer(evaluation: Any) -> str:
    """Message of a refusal; empty if there is none."""
    try:
        evaluation()
    except EthBrakeError as error:
        return str(error)
    return ""


def predicts(*parts: Any) -> bool:
    return any(id(part) in reach.predictors() for part in parts)


def test_all_that_predicts__asks_what_it_covers() -> None:
    """A function outside the plain game that computes motion calls ``require``, or only functions that do call it."""
    guarded = {identity for identity in reach.nodes() if id(require) in reach.reached_from(identity)}

    def is_guarded(identity: int, above: tuple[int, ...] = ()) -> bool:
        above = (*above, identity)
        callers = reach.users().get(identity, set()) - {*above}
        return identity in guarded or (bool(callers) and all(is_guarded(caller, above) for caller in callers))

    silent = [place for identity, (place, _) in reach.nodes().items()
              if identity in reach.predictors() and not is_guarded(identity)]  # fmt: skip
    assert silent == [] and len(reach.predictors()) > 30


@pytest.mark.parametrize("spec", specs())
def test_agents_and_shields__that_predict_are_refused(icy: eb.Scenario, spec: str) -> None:
    try:
        (team,) = make_teams(spec, scenario=PAPER).values()
    except MissingExtra:
        pytest.skip("an optional package is missing")
    parts = [type(agent) for agent in team.drivers.values()] + [type(team.shield)]
    plain = answer(lambda: eb.evaluate(PAPER, spec, episodes=2, harm_count="total"))
    said = answer(lambda: eb.evaluate(icy, spec, episodes=2, harm_count="total"))
    assert said == plain or "does not cover Ice, by which world 0 departs from the plain game" in said
    assert said or not predicts(*parts)


@pytest.mark.parametrize("name", measure_names())
def test_measures__that_predict_are_refused(icy: eb.Scenario, name: str) -> None:
    measure = MEASURES[name]
    plain, said = (  # the same worlds
        answer(lambda: eb.evaluate(scenario, "full_brake", episodes=2, measures=name, harm_count="total"))  # noqa: B023
        for scenario in (PAPER, icy)
    )
    assert said == plain or "does not cover Ice, by which world 0 departs from the plain game" in said
    assert said or not predicts(measure.of, measure.watch)


@pytest.mark.parametrize("group", sorted(GROUPS))
def test_features__that_predict_are_refused_at_the_door(icy: eb.Scenario, group: str) -> None:
    assert predicts(GROUPS[group].function) and not answer(
        lambda: eb.parallel_env(PAPER, observation=[group], reward="total-harm").reset(seed=7)
    )
    with refused("does not cover Ice, by which world 0 departs from the plain game; departures that it covers: back"):
        eb.parallel_env(icy, observation=[group], reward="total-harm").reset(seed=7)


@pytest.mark.parametrize(
    "name", ["front_1.stopping_margin", "rear_2.fitting_deceleration", "obstacle.stopping_margin", "obstacle", "rear_1"]
)
def test_features__that_assume_exact_braking_are_refused(icy: eb.Scenario, name: str) -> None:
    env = eb.parallel_env(icy, observation=["own", name], reward="total-harm")
    with refused("', which an observation may leave out, does not cover Ice, by which world 0 departs"):
        env.reset(seed=7)
    policy = eb.policy_agent(lambda seen: seen[:, 0] * 0.0, name="mine", observation=["own.speed", name])
    with refused("does not cover Ice, by which world 0 departs"):
        eb.evaluate(icy, {"mine": policy}, episodes=2, harm_count="total")


def test_features__that_assume_exact_braking_cover_what_brakes_exactly() -> None:
    register_physics("same", Exact())
    for physics in ("same", *(name for name in ("paper-map",) if name in PHYSICS)):
        seen, _ = eb.parallel_env(PAPER.replace(physics=physics), reward="total-harm").reset(seed=7)
        assert (seen["vehicle_2"] == eb.parallel_env(PAPER).reset(seed=7)[0]["vehicle_2"]).all()
    eb.parallel_env("realistic-truck-buildup").reset(seed=7)
    eb.parallel_env("paper-random-obstacle").reset(seed=7)


@pytest.mark.parametrize("name", [name for name in ("ttc_s", "drac_mps2") if name in MEASURES])
def test_measures__that_assume_exact_motion_are_refused(icy: eb.Scenario, name: str) -> None:
    with refused("does not cover Ice, by which world 0 departs from the plain game"):
        eb.evaluate(icy, "full_brake", episodes=2, measures=name, harm_count="total")


def test_functions__that_predict_worlds_are_refused() -> None:
    """All functions that need nothing but a game, worlds and a vehicle: proofs, closed forms and searches."""
    measures = [part for name in measure_names() for part in (MEASURES[name].of, MEASURES[name].watch)]
    game = eb.open_game(PAPER, reward="total-harm")[1]._replace(physics=Ice())
    given = {"game": game, "alert": game.marked(PAPER.sample(3, 7)), "last": game.reset(PAPER.sample(3, 7)), "body": 2}
    given["state"] = given["alert"]
    called = []
    for place, node in (reach.nodes()[identity] for identity in reach.predictors()):
        needed = reach.needed_arguments(node)
        if needed and needed <= given.keys() and needed & {"alert", "state"} and node not in measures:
            with refused("does not cover Ice, by which world 0 departs"):
                node(**{name: given[name] for name in needed})
            called.append(place)
    assert {"agents.pairwise:pairwise", "agents.e_v2x_bm:coupled"} <= {*called}


def played(physics: Any, *specs: str, measures: str = "", worlds: State | None = None) -> Any:
    """Evaluation in which the physics of the game has been replaced, without a key of the scenario."""
    game = eb.open_game(PAPER, reward="total-harm")[1]._replace(physics=physics)
    teams = {spec: make_teams(spec, scenario=PAPER)[spec] for spec in specs}
    chosen = [MEASURES[name] for name in measures.split(",") if name]
    return evaluate_teams(PAPER.sample(20, 7) if worlds is None else worlds, teams, game, measures=chosen)


def test_physics__changes_what_happens_and_nothing_predicts_it() -> None:
    """The bound was stored for the same worlds in the plain game, where it holds."""
    measures = [name for name in ("proven_harm", "contact_avoidable") if name in MEASURES]
    plain = played(None, "full_brake", "e_v2x_bm:pairwise", measures=",".join(measures))
    ice = played(Ice(), "full_brake")["full_brake"]["total_harm"]
    assert (abs(ice - plain["full_brake"]["total_harm"]) > 1.0).mean() > 0.3
    for name in measures:
        with refused("a proof does not cover Ice, by which world 0 departs"):
            played(Ice(), "full_brake", measures=name)
    with refused("e_v2x_bm:pairwise does not cover Ice"):
        played(Ice(), "e_v2x_bm:pairwise")
    with refused("does not cover black ice"):
        played(Named(), "coast+step")
    icy, honest = eb.open_game(PAPER, reward="total-harm")[1]._replace(physics=Named()), eb.open_game(PAPER)[1]
    for ask in (
        lambda: icy.reset(PAPER.sample(2, 7)).harm("honest"),
        lambda: honest._replace(physics=Named()).reset(PAPER.sample(2, 7)),  # also pays no honest reward
    ):
        with refused("the honest cost does not cover black ice, by which world 0 departs from the plain game; depart"):
            ask()


def test_exact_physics__keeps_everything() -> None:
    specs = ["full_brake", "e_v2x_bm", "e_v2x_bm:pairwise", "coast+step"]
    measures = ",".join(name for name in ("pushed_m", "contact_avoidable", "proven_harm") if name in MEASURES)
    plain, exact = (played(physics, *specs, measures=measures) for physics in (None, Exact()))
    for spec in specs:
        assert {*plain[spec]} == {*exact[spec]} >= {"honest_cost"}
        for name, values in plain[spec].items():
            np.testing.assert_array_equal(values, exact[spec][name], name)
    register_physics("same", Exact())
    eb.open_game(PAPER.replace(physics="same"))[1].reset(PAPER.sample(2, 7))
    assert eb.record_episode(PAPER.replace(physics="same"), "full_brake").gaps_m.size
    v2x = {"preset": "nominal", **({"persistence": "periodic"} if "persistence" in CHANNEL_KEYS else {})}
    eb.parallel_env(PAPER.replace(physics="same", v2x=v2x)).reset(seed=7)


def with_row(worlds: State, friction: float) -> State:
    """The worlds with one more quantity of vehicles, which only the motion knows."""
    return worlds._replace(car=np.concatenate([worlds.car, np.full_like(worlds.car[:, :1], friction)], axis=1))


def test_quantity__that_a_feature_does_not_know_is_refused_and_simulations_go_on(monkeypatch) -> None:
    """0 is the world without the quantity."""
    plain = PAPER.sample(20, 7)
    icy, dry = with_row(plain, 0.3), with_row(plain, 0.0)
    monkeypatch.setattr(departures, "CAR_NAMES", (*departures.CAR_NAMES, "ice"))
    assert icy.departures == {"ice"} and dry.departures == frozenset()
    for spec in ("e_v2x_bm:pairwise", "plan", "best_harm:20"):
        if spec.partition(":")[0] in AGENTS:
            with refused("does not cover ice, by which world 0 departs"):
                played(None, spec, worlds=icy)
    for name in ("proven_harm", "contact_avoidable", "best_known"):
        if name in measure_names():
            with refused("does not cover ice, by which world 0 departs"):
                played(None, "coast", worlds=icy, measures=name)
    simulated = [played(None, "e_v2x_bm", "coast+step", worlds=worlds, measures="pushed_m") for worlds in (icy, plain)]
    assert simulated[0]["e_v2x_bm"]["total_harm"].tolist() == simulated[1]["e_v2x_bm"]["total_harm"].tolist()


def test_departures__of_a_state() -> None:
    plain = PAPER.sample(3, 7)
    assert plain.departures == frozenset() and plain.is_exact

    def changed(array: str, row: int, world: int, body: int, value: float) -> State:
        values = getattr(plain, array).copy()
        values[world, row, body] = value
        return plain._replace(**{array: values})

    cases = {
        departures.BUILD_UP: changed("car", BRAKE_RATE, 1, 3, 9.0),
        departures.OBSTACLE: changed("line", GAP, 1, 0, 40.0),
        departures.BACKWARD: changed("line", SPEED, 1, 2, -0.1),
    }
    for name, state in cases.items():
        assert state.departures == {name} and state.take([0, 2]).departures == frozenset()
        where = "by which world 1 departs from the plain game; departures that it covers: ice"
        with refused(f"mine does not cover {name}, {where}"):
            require(state, "mine", {"ice"})
        require(state, "mine", {name})
        require(state, "mine", simulates=True)


def test_mark__travels_with_the_worlds() -> None:
    plain, icy = PAPER.sample(3, 7), mark(PAPER.sample(3, 7), ["ice"])
    assert State.join([plain, icy]).departures == State.join([icy, plain]).departures == {"ice"}
    assert icy.take([1]).departures == icy.read_only().departures == mark(icy, []).departures == {"ice"}
    for simulates in (False, True):
        with refused("mine does not cover ice"):
            require(icy, "mine", simulates=simulates)
    with refused("scenario 'paper-random' does not cover ice, by which world 0 departs"):
        eb.evaluate(icy, "full_brake", scenario="paper-random")


def test_physics__says_how_it_departs() -> None:
    assert [departures_of(physics) for physics in (None, Ice(), Exact(), Named())] == [
        frozenset(), {"Ice"}, frozenset(), {"black ice"}
    ]  # fmt: skip
    wrong = Ice()
    wrong.departures = "ice"  # type: ignore[attr-defined]
    with pytest.raises(InvalidInput, match="physics Ice: departures = 'ice': must be a set of names; empty: exact"):
        departures_of(wrong)
