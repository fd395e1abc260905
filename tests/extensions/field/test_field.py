"""Agents of the field, by hand: car following, RSS, UN R157's models and AEB."""

from collections.abc import Callable

import numpy as np
import pytest

import ethbrake_marl as eb
from ethbrake_marl.agent_names import group, make_agent
from ethbrake_marl.episode.state import TIME
from ethbrake_marl.errors import InvalidInput, UnknownName
from ethbrake_marl.extensions.field.controllers import LAWS, KnownMotion, Parameters, fuzzy_criteria
from ethbrake_marl.motion.layout import GAP
from tests.episode.lines import state_of
from tests.refused import refused


def seen(gap, speed, front, front_force=0.0, own=0.0):
    columns = (np.atleast_1d(np.asarray(each, float)) for each in (gap, speed, front, front_force, own))
    return KnownMotion(*np.broadcast_arrays(*columns), 0.1)


def called(name, *given, **parameters):
    law = LAWS[name]
    return np.round(law.command(seen(*given), Parameters(**{**law.parameters, **parameters})), 6).tolist()


TWO = eb.Scenario(
    name="two", vehicles=2, gaps_m=50, speeds_mps=30, braking_capacity_mps2=[6, 9], driving_capacity_mps2=3, mass_t=1,
    latency_s=[0, 0.05], restitution=0,
)  # fmt: skip


def driven(spec, scenario=TWO, steps=22):
    loaded, game = eb.open_game(scenario)
    team = eb.Team("one", {2: eb.make_agent(spec, scenario=scenario)})
    states = [state for _, state in eb.play(game, loaded.sample(1, 7), team)]
    return np.round([state.wanted[0, 2] for state in states[1 : steps + 1]], 3).tolist()


def test_idm__calls_for_nothing_at_its_equilibrium_gap() -> None:
    # IDM: at its equilibrium gap (s0 + v T) / sqrt(1 - (v / v0)^4) it calls for nothing, at rest at s0, too. Closing
    # with 2 m/s at 20 m it wants s* = 2 + 30 + 40 / (2 sqrt 2.8) = 43.952286 m: 1.4 (1 - 0.130118 - 4.829509).
    assert called("idm", [32 / np.sqrt(1 - (20 / 33.3) ** 4), 2.0], [20.0, 0.0], [20.0, 0.0]) == [-0.0, 0.0]
    assert called("idm", 20, 20, 18) == [-5.54348]


def test_acc_and_cacc__by_hand() -> None:
    # ACC: 0.23 (30 - 1.1 x 20) - 0.07 x 2; beyond 2 s of headway 0.4 (33.3 - 20). CACC gives the speed at the next
    # decision, 0.1 s on: too near (-2.5 m) 0.45 x -2.5 - 0.05 x 2, right (0.1 m) 0.45 x 0.1 - 0.0125 x 2, far (10 m)
    # 0.05 - 0.1.
    assert called("acc", [30, 41], 20, [18, 20]) == [1.7, 5.32]
    assert called("cacc", [20, 22.6, 32.5], 20, 18) == [-12.25, 0.2, -0.5]


def test_rss__brakes_within_the_safe_distance() -> None:
    # RSS: at 20 m/s behind 20 m/s the safe distance is 20 + 1.75 + 23.5^2 / 8 - 400 / 16 = 65.78125 m.
    assert called("rss", [65.78, 65.79], 20, 20) == [-4.0, 0.0]


def test_aeb__brakes_fully_from_its_time_to_collision_until_rest() -> None:
    # 10 m/s closing over 14 m is 1.4 s; 12 m/s over 19 m is 1.58 s, which asks for 144 / 38 = 3.8 m/s2.
    def brakes(spec, gap, speed, front, memory=np.inf):
        state = state_of([[gap]], [[front, speed]], braking_capacity_mps2=[6.0, 7.0])
        return eb.make_agent(spec, scenario=TWO).act(state, np.array([memory]), 2)[0][0] == -7.0

    assert brakes("aeb", 14, 20, 10) and not brakes("aeb", 16, 20, 10) and not brakes("aeb", 19, 22, 10)
    assert brakes("aeb:required=3.7", 19, 22, 10) and not brakes("aeb:required=3.9", 19, 22, 10)
    assert brakes("aeb", 50, 10, 20, memory=0.0)  # braking since the alert; it does not release, even at rest
    assert brakes("aeb", 50, 0, 20, memory=0.0)
    assert brakes("aeb:release_ttc=2", 19, 20, 10, 0.0) and not brakes("aeb:release_ttc=2", 21, 20, 10, 0.0)


def test_aeb__does_not_let_go_in_an_episode__unless_it_may() -> None:
    def forces_after_onset(spec):
        forces = eb.record_episode("standards-ccrs-followed", spec, number=26, sample_s=0.1).forces_mps2[:, 1]
        return set(forces[np.argmax(forces < 0.0) :].tolist())

    assert forces_after_onset("aeb") == {-9.0} and forces_after_onset("aeb:release_ttc=1.5") == {-9.0, 0.0}


def test_r157_driver__lets_go_again_beyond_two_seconds_and_two_metres() -> None:
    # It brakes since 0 s: at 10 m/s it lets go beyond 2 + 2 x 10 = 22 m, and beyond 2 + 100 x 10 m with headway=100.
    def goes_on(spec, gap, front_force=0.0):
        state = state_of([[gap]], [[10.0, 10.0]], force_mps2=[[front_force, -5.0]])
        clock = state.clock.copy()
        clock[:, TIME] = 5.0
        return eb.make_agent(spec, scenario=TWO).act(state._replace(clock=clock), np.zeros(1), 2)[0][0] < 0.0

    assert goes_on("r157_human", 21.9) and not goes_on("r157_human", 22.1)
    assert goes_on("r157_human:front=0.5:headway=100", 1001) and not goes_on("r157_human:front=0.5:headway=100", 1003)


def test_fuzzy_model__does_not_let_go_in_contact() -> None:
    # At 10 m/s, 0.5 m ahead, 20 + 10.7 m would be safe: it brakes with its 4 m/s2, though the gap does not close.
    state = state_of([[0.5]], [[10.0, 10.0]], force_mps2=[[0.0, -4.0]])
    agent = eb.make_agent("r157_fsm", scenario=TWO)
    clock = state.clock.copy()
    clock[:, TIME] = 5.0
    state = state._replace(clock=clock)
    assert agent.act(state, np.zeros(1), 2)[0].tolist() == [-4.0]
    assert agent.act(state, np.full(1, np.inf), 2)[0].tolist() == [0.0]  # such a danger does not begin


def test_fuzzy_model__by_hand() -> None:
    # The fuzzy criteria, 20 m/s behind 20 m/s: safe beyond 15 + 50 - 200/7 + 2 + 2 = 40.43 m of gap, unsafe within 15
    # + 33.33 - 28.57 + 2 = 21.76 m; 2 m/s closing adds the critical one: 1.5 + 4 / 8 = 2 m and 1.5 + 4 / 12 = 1.83 m.
    p = Parameters(**LAWS["r157_fsm"].parameters)
    assert [np.round(each, 4).tolist() for each in fuzzy_criteria(seen([41, 31.0952381, 21], 20, 20), p)] == [
        [0.0, 0.5, 1.0],
        [0.0, 0.0, 0.0],
    ]
    assert [np.round(each, 4).tolist() for each in fuzzy_criteria(seen([2.1, 1.9166667, 1.8], 20, 18), p)] == [
        [1.0, 1.0, 1.0],
        [0.0, 0.5, 1.0],
    ]
    # Braking with 4 m/s2 it will be slower than its front one after 0.75 s: what matters is 4 / 8 = 0.5 m.
    assert fuzzy_criteria(seen([0.49, 0.51], 20, 18, 0, -4), p)[1].tolist() == [1.0, 0.0]


def test_un_r157__reacts_eases_off_and_brakes_with_a_jerk() -> None:
    # He sees at once that Vehicle 1 brakes with 6 m/s2 at less than 2 s ahead: nothing for 0.4 s, then 0.4 m/s2 for
    # 0.75 s, and then 12.65 m/s3 up to 0.774 g. He stays with it.
    jerk = [-1.665, -2.93, -4.195, -5.46, -6.725]
    assert driven("r157_human") == [0.0] * 4 + [-0.4] * 7 + jerk + [-7.593] * 6
    assert driven("r157_human:reaction=0.15:jerk=100", steps=8) == [0.0] * 4 + [-0.4] + [-7.593] * 3
    gentle = TWO.replace(braking_capacity_mps2=[4.9, 9])  # he notices it by the time to collision
    assert driven("r157_human", gentle, 34)[-8:] == [0.0] * 7 + [-0.4]
    assert driven("r157_fsm", steps=12) == [-0.0] * 7 + [-1.265, -2.53, -3.795, -4.0, -4.0]


@pytest.mark.parametrize(
    ("spec", "command"),
    [
        *[("idm", 0.478), ("acc", 1.32), ("cacc", 1.32), ("rss", 0), ("r157_human", 0), ("r157_fsm", 0)],
        *[("aeb", 0), ("human", 0)],
    ],
)
def test_vehicle_1__brakes_for_nothing_without_an_obstacle(spec: str, command: float) -> None:
    worlds, agent = TWO.sample(1, 7), eb.make_agent(spec, scenario=TWO)
    commands, _ = agent.act(worlds, agent.begin(worlds, 1), 1)
    assert commands.round(3).tolist() == [command]
    assert (agent.name, agent.knows) == (spec, "messages")


def test_synchronised__waits_for_the_slowest_and_brakes_as_the_weakest() -> None:
    slow = TWO.replace(latency_s=[0.2, 0.7], braking_capacity_mps2=[5, 8])
    agent, alert = eb.make_agent("synchronised", scenario=slow), slow.sample(1, 7)
    clock = alert.clock.copy()
    clock[:, TIME] = 0.7
    later = alert._replace(clock=clock)
    for body in (1, 2):
        assert agent.act(alert, None, body)[0].tolist() == [0.0]
        assert agent.act(later, None, body)[0].tolist() == [-5.0]
    unknown = later._replace(know=np.full_like(alert.know, np.inf))
    assert agent.act(unknown, None, 2)[0].tolist() == [-8.0]


def test_vehicle_1__brakes_for_an_obstacle_that_stands() -> None:
    # 30 m/s over 44 m: 1.47 s, and 30^2 / (2 44) = 10.2 m/s2.
    worlds, agent = TWO.replace(obstacle_gap_m=44).sample(1, 7), eb.make_agent("aeb", scenario=TWO)
    assert agent.act(worlds, agent.begin(worlds, 1), 1)[0].tolist() == [-6.0]


def test_nobody_is_ahead_until_news_of_it_have_come() -> None:
    late = TWO.replace(v2x={"link_latency_s": 0.6, "senses": "none"}, latency_s=[0, 0.6], gaps_m=10)
    assert driven("idm", late, 1)[0] < -3.0
    worlds = late.sample(1, 7)
    assert (
        np.isinf(KnownMotion.of(worlds, 2, 0.1).gap_m)
        and KnownMotion.of(worlds._replace(know=0 * worlds.know), 2, 0.1).gap_m == 10
    )


@pytest.mark.parametrize("periodic", [False, True])
def test_old_news__are_moved_on_until_their_sender_stands(periodic: bool) -> None:
    """Behind a front vehicle that brakes fully the believed gap is the true one, and so are the commands."""
    channel = {"preset": "nominal", "sensing_s": [3, 4]} | ({"persistence": "periodic"} if periodic else {})
    late, gaps = TWO.replace(speeds_mps=15, v2x=channel), []

    class Spy(type(make_agent("idm", scenario=TWO))):
        def act(self, state, memory, body):
            gaps.append(state.line[:, GAP, 1].copy())
            return np.full(state.n, -2.5), memory

    spy = make_agent("idm", scenario=late)
    spy.__class__ = Spy
    loaded, game = eb.open_game(late)
    states = [state for _, state in eb.play(game, loaded.sample(20, 3), eb.Team("spy", {2: spy}))]
    assert len(gaps) > 20
    for believed, state in zip(gaps, states, strict=False):
        assert np.abs(believed - state.gaps_m[:, 0]).max() < 1e-6


def test_agent__that_is_made_for_another_time_step_is_refused() -> None:
    with refused("agent 'cacc' was made for decisions every 0.1 s, but scenario 'two' has one every 0.4 s"):
        eb.evaluate(TWO.replace(time_step_s=0.4), {"cacc": make_agent("cacc")}, episodes=2)


def test_agent__whose_messages_lack_a_piece_is_refused_unless_it_sees_the_vehicle_ahead() -> None:
    pytest.importorskip("ethbrake_marl.extensions.messages")  # whose key is `tells`
    blind = {"tells": ["place", "speed"], "senses": "none"}
    with refused("agent 'aeb': messages of vehicle_1 do not contain its acceleration (key v2x.tells)"):
        eb.evaluate(TWO.replace(v2x=blind), "aeb", episodes=2)
    sees = {"preset": "nominal", "senses": "both", "sensing_s": [0, 0]}
    harms = [
        eb.evaluate(TWO.replace(gaps_m=20, v2x=each), "acc", episodes=5)["acc"]["total_harm"].tolist()
        for each in (sees, {**sees, "tells": []})
    ]
    assert harms[0] == harms[1] and harms[0][0] > 0.0


GOLDEN = {  # mean first-impact harm of 50 worlds, seed 7; of idm, acc, cacc and rss recorded from version 0.5
    "paper-random": [16.1551, 42.095, 16.8336, 40.1944, 61.0173, 43.0834, 19.5251, 80.9137],
    "cooperation-2-blocked": [27.7127, 45.6304, 28.4767, 45.7241, 65.9715, 46.4936, 30.4407, 85.5706],
}


@pytest.mark.parametrize("scenario", GOLDEN)
def test_field__has_the_recorded_harm(scenario: str) -> None:
    result = eb.evaluate(scenario, "field", episodes=50)
    assert [*result.columns] == group("field") == [*LAWS, "human"]
    assert [round(float(each["first_impact_harm"].mean()), 4) for each in result.columns.values()] == GOLDEN[scenario]


@pytest.mark.parametrize("spec", ["idm:T=1.0", "r157_human"])
def test_role__is_the_same_agent_as_a_driver_from_its_first_decision_on(spec: str) -> None:
    """Vehicle 2 coasts until its latency has elapsed; then it decides at the same times."""
    base = eb.load_scenario("paper-random").replace(early_impacts="keep", latency_s=[0.0, 0.0, 0.8])
    scripted = base.replace(roles={"vehicle_2": spec, "vehicle_3": "learner"}, latency_s=0.0)
    learner = base.replace(latency_s=0.0)
    driven_by_role = eb.evaluate(scripted, "full_brake", episodes=5)["full_brake"]["total_harm"]
    assert driven_by_role.tolist() == eb.evaluate(learner, spec, episodes=5)[spec]["total_harm"].tolist()


REFUSED: dict[str, Callable[[], object]] = {
    "agent 'idm:a=0': a must be a finite number above 0, for instance a=1.4": lambda: make_agent("idm:a=0"),
    "agent 'idm:T=1:T=2': parameter T is given twice": lambda: make_agent("idm:T=1:T=2"),
    "agent 'acc:T': T must be a finite number of 0 or more, for instance T=1.1": lambda: make_agent("acc:T"),
    "agent 'r157_fsm:b_min=7': b_min = 7: must be at most b_max, which is 6": lambda: make_agent("r157_fsm:b_min=7"),
    "unknown agent 'idm:t=1': parameter 't'": lambda: make_agent("idm:t=1"),
    "agent 'e_v2x_bm': vehicle_1 is driven by 'idm'": lambda: eb.evaluate(
        TWO.replace(roles={"vehicle_1": "idm", "vehicle_2": "learner"}), "e_v2x_bm", episodes=2
    ),
}


@pytest.mark.parametrize("message", REFUSED)
def test_controller__is_refused(message: str) -> None:
    with refused(message, UnknownName if message.startswith("unknown") else InvalidInput):
        REFUSED[message]()
