"""Published tests with a human driver behind: the driver reacts to Vehicle 2, and the rows are those of the tests."""

import numpy as np
import pytest

import ethbrake_marl as eb

REACTION_S = 1.25
TESTS = ("ccrs", "ccrm-2026", "ccrb-2026", "fmvss-127", "r157")


@pytest.mark.parametrize("test", TESTS)
def test_followed__has_the_rows_of_the_test_and_time_gaps_behind(test: str) -> None:
    alone, followed = (eb.load_scenario(name).sample(400, seed=7) for name in
                       (f"standards-{test}", f"standards-{test}-followed"))  # fmt: skip
    shown = [np.unique(np.column_stack([worlds.gaps_m[:, 0], worlds.speeds_mps[:, :2]]), axis=0)
             for worlds in (alone, followed)]  # fmt: skip
    assert len(shown[0]) > 5 and shown[0].tolist() == shown[1].tolist()
    assert (followed.speeds_mps[:, 2] == followed.speeds_mps[:, 1]).all()
    time_gaps = followed.gaps_m[:, 1] / followed.speeds_mps[:, 2]
    assert np.unique(time_gaps.round(2)).tolist() == [0.5, 0.75, 1.0, 1.25, 1.5]
    assert alone.braking_capacity_mps2[0, 0] == followed.braking_capacity_mps2[0, 0]


@pytest.mark.parametrize(("agent", "brakes_at_s"), [("full_brake", 0.2), ("coast", np.inf)])
def test_human__brakes_so_long_after_vehicle_2_slows__and_not_by_a_clock(agent: str, brakes_at_s: float) -> None:
    scenario = eb.load_scenario("standards-ccrb-2026-followed")
    roles = {**scenario.roles, "vehicle_3": f"human:reaction={REACTION_S}:sd=0"}
    calm = scenario.replace(
        table=None, gaps_m=[400, 60], speeds_mps=[30, 20, 20], braking_capacity_mps2=[4, 9, 6], roles=roles
    )
    record = eb.record_episode(calm, agent, sample_s=0.1)
    until = record.time_s < 6.0
    brakes = record.forces_mps2[until, 2] < -1.0
    assert brakes.any() == np.isfinite(brakes_at_s)
    if brakes.any():
        begun_s = record.time_s[until][brakes][0]
        assert brakes_at_s + REACTION_S <= begun_s <= brakes_at_s + REACTION_S + 0.31  # decisions are 0.1 s apart


def test_who_brakes_hard_is_struck__who_brakes_early_is_not() -> None:
    costs = eb.evaluate("standards-fmvss-127-followed", "full_brake,idm", episodes=200)
    struck = {agent: columns["collided"].mean() for agent, columns in costs.columns.items()}
    assert struck["full_brake"] > 0.8 and struck["idm"] < 0.2
    assert costs["full_brake"]["honest_cost"].mean() > 10.0 * costs["idm"]["honest_cost"].mean()
