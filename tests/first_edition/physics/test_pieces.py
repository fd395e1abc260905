"""Vehicles that brake in pieces: a profile, fixed at the alert."""

import numpy as np

import ethbrake_marl.first_edition as eb
from ethbrake_marl.first_edition.agents.making import make_agent
from ethbrake_marl.first_edition.engine.profiles import profile_problem
from ethbrake_marl.first_edition.evaluation import trial
from ethbrake_marl.first_edition.physics.advance import advance
from ethbrake_marl.first_edition.physics.state import make_worlds
from ethbrake_marl.first_edition.physics.trace import segment_pieces
from ethbrake_marl.first_edition.training.settings import read_settings


def one(latency_s, **settings):
    """A vehicle at 20 m/s, 1 km behind an obstacle, that brakes with 3 m/s2 and 1 s later with 7."""
    worlds = make_worlds(
        [90],
        [20, 20],
        braking_capacity_mps2=8,
        driving_capacity_mps2=3,
        latency_s=latency_s,
        mass_t=1,
        restitution=0,
        obstacle_gap_m=1000,
        **settings,
    )
    return worlds.play_pieces({0: [(0, 3), (1, 7)]})


def told(worlds):
    """Way, speed and acceleration in force of Vehicle 1."""
    return [
        round(float(each), 9)
        for each in (1000 - worlds.obstacle_gap_m[0], worlds.speeds_mps[0, 0], worlds.command_mps2[0, 0])
    ]


def at(latency_s, until_s, **settings):
    return told(advance(one(latency_s, **settings), [[-8.0, -8.0]], until_s=until_s)[0])


PAPER = eb.load_scenario("paper-random")


def front(role):
    return PAPER.replace(roles={"vehicle_1": role, "vehicle_2": "learner"})


def harm(scenario, agent, worlds=None):
    sample = scenario.sample(30, 7) if worlds is None else worlds
    return eb.evaluate(sample, {"it": make_agent(agent, scenario=scenario)}, scenario=scenario).outcome("it")


SOFT = front({"profile": [[0, 3], [1, 5]]})


def test_profile__by_hand() -> None:
    # 20 - 3 m/s after 18.5 m, where the second piece is in force; then 17^2 / 14 m to a stop.
    assert at(0, 0) == [0.0, 20.0, -3.0]
    assert at(0, 0.5) == [9.625, 18.5, -3.0]
    assert at(0, 1) == [18.5, 17.0, -7.0]
    assert at(0, 60) == [39.142857143, 0.0, -7.0]
    # 8 m more
    assert at(0.4, 0.3) == [6.0, 20.0, 0.0]
    assert at(0.4, 1.4) == [26.5, 17.0, -7.0]
    assert at(0.4, 60) == [47.142857143, 0.0, -7.0]


def test_profile__of_brakes_that_build_up() -> None:
    # With 6 m/s3 the first piece is there after 0.5 s (9.875 m, then 9.25 m to 17.75 m/s after 1 s), the second 4/6 s
    # later.
    assert at(0, 1, brake_rate_mps3=6) == [19.125, 17.75, -3.0]
    assert at(0, 1 + 4 / 6, brake_rate_mps3=6)[1:] == [14.416666667, -7.0]


def test_segment__knows_how_far_after_the_latency_it_begins() -> None:
    worlds = one(0.4)  # wherever the pieces fall in a segment
    for until_s in np.arange(0.1, 6, 0.1):
        worlds = advance(worlds, [[2.0, -8.0]], until_s=until_s)[0]
    assert told(worlds) == [47.142857143, 0.0, -7.0]
    (rows,) = segment_pieces(one(0.4), np.array([[2.0, -8.0]]), np.array([6.0]))
    assert [round(float(time), 9) for time in rows[:, 0]] == [0.0, 0.4, 1.4, 2.9, 3.828571429]
    assert rows[:, 5].tolist() == [0.0, -3.0, -7.0, -7.0, 0.0]


def test_role__of_one_piece_is_that_constant_command() -> None:
    # One piece is that constant command to the bit; two that say the same, within rounding.
    constant = harm(front("constant:5"), "e_v2x_bm").first_impact_harm
    assert (harm(front({"profile": [[0, 5]]}), "e_v2x_bm").first_impact_harm == constant).all()
    twice = harm(front({"profile": [[0, 5], [0.7, 5]]}), "e_v2x_bm").first_impact_harm
    assert np.allclose(twice, constant, rtol=1e-12, atol=1e-12)
    assert SOFT.declared()["roles"]["vehicle_1"] == {"profile": [[0.0, 3.0], [1.0, 5.0]]}
    assert SOFT.roles["vehicle_1"] == "profile:0=3,1=5"
    assert SOFT.replace() == front("profile:0=3,1=5") == SOFT
    assert (
        trial.load_runnable("paper-random", read_settings(["roles.vehicle_1=profile:0=3,1=5"]).scenario).roles
        == SOFT.roles
    )


def test_predictions__are_what_is_done() -> None:
    # E-V2X-BM and shield are told the pieces at the alert: what they expect is what is done.
    constant = harm(front("constant:5"), "e_v2x_bm").first_impact_harm
    check_predicted("e_v2x_bm")
    bound = harm(SOFT, "e_v2x_bm").first_impact_harm
    assert (harm(SOFT, "coast+step").first_impact_harm <= bound + 1e-9).all()
    assert float(bound.sum()) != float(constant.sum())


def check_predicted(agent: str) -> None:
    found = harm(SOFT, agent)
    assert np.allclose(found.first_impact_harm, found.predicted_harm, rtol=1e-9, atol=1e-9)


def test_identity__of_worlds_tells_their_profiles_apart() -> None:
    found = [
        profile_problem(front({"profile": pieces}).sample(3, 7).worlds, [1], horizon_s=8.0).identity
        for pieces in ([[0, 3], [1, 5]], [[0, 3], [1, 4]], [[0, 3], [2, 5]])
    ]
    assert len({int(one) for each in found for one in each}) == 9
