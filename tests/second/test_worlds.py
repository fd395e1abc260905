"""Worlds of the second edition against those of the first."""

import numpy as np
import pytest

import ethbrake_marl.first_edition.scenario as first
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.first_edition.scenario.tables import worlds_from_table as first_from_table
from ethbrake_marl.motion.layout import (
    BRAKE_RATE,
    BRAKING,
    CAR_ROWS,
    DRIVING,
    FAR_M,
    FORCE,
    GAP,
    HIT,
    LATENCY,
    LIMIT,
    LINE_ROWS,
    MASS,
    OWN_LATENCY,
    RELEASE_RATE,
    RESTITUTION,
    SPEED,
    WEIGHT,
)
from ethbrake_marl.worlds.catalogue import load_scenario
from ethbrake_marl.worlds.given import worlds_from_table
from tests.fixtures.scenarios import SHIPPED


def as_state(worlds):
    """Arrays line, car, know of the first edition's worlds."""
    n, N, v = worlds.n, worlds.N, worlds.vehicles
    line, car, know = np.zeros((n, LINE_ROWS, N + 1)), np.zeros((n, CAR_ROWS, N + 1)), np.zeros((n, N + 1, N + 1))
    line[:, SPEED, 1:], line[:, FORCE, 1:] = worlds.speeds_mps, worlds.command_mps2
    line[:, GAP, 0], line[:, GAP, 1:N] = np.minimum(worlds.obstacle_gap_m, FAR_M), worlds.gaps_m
    line[:, GAP, N] = np.inf
    line[:, HIT, 0], line[:, HIT, 1:N] = worlds.obstacle_hit, worlds.pair_hit
    rows = {
        MASS: v.mass_t,
        LIMIT: v.speed_limit_mps,
        LATENCY: v.latency_s,
        BRAKING: v.braking_capacity_mps2,
        DRIVING: v.driving_capacity_mps2,
        BRAKE_RATE: v.brake_rate_mps3,
        RELEASE_RATE: v.release_rate_mps3,
        WEIGHT: v.harm_weight,
        OWN_LATENCY: v.own_latency_s,
    }
    for row, values in rows.items():
        car[:, row, 1:] = values
    car[:, MASS, 0] = car[:, BRAKE_RATE, 0] = car[:, RELEASE_RATE, 0] = np.inf
    car[:, RESTITUTION], know[:, 1:, 1:] = v.restitution[:, np.newaxis], v.known_from_s
    return line, car, know


@pytest.mark.parametrize("seed", [7, 2024])
@pytest.mark.parametrize("name", SHIPPED)
def test_worlds__have_the_bits_of_the_first_edition(name: str, seed: int) -> None:
    channel = "list" if seed == 7 else "training"
    old = first.load_scenario(name).sample(1500, seed, first=seed, channel=channel)
    new = load_scenario(name).draw(1500, seed, first=seed, channel=channel)
    for one, other in zip(as_state(old.worlds), (new.worlds.line, new.worlds.car, new.worlds.know), strict=True):
        assert one.tobytes() == other.tobytes()
    assert new.rejected == old.rejected
    assert new.worlds.clock[:, 5].tolist() == old.index.tolist()
    for one, other in ((old.types, new.types), (old.scenarios, new.scenarios), (old.recordings, new.recordings)):
        assert other.tolist() == (np.full(other.shape, "") if one is None else one).tolist()


@pytest.mark.parametrize("name", SHIPPED)
def test_content__is_that_of_the_first_edition(name: str) -> None:
    old, new = first.load_scenario(name), load_scenario(name)
    assert new.declared() == old.declared()
    assert new.content() == old.content(())
    assert (new.has_obstacle, [i - 1 for i in new.learners]) == (old.has_obstacle, list(old.learners))


@pytest.mark.parametrize("name", SHIPPED)
def test_given_worlds__are_those_of_the_first_edition_or_refused_in_its_words(name: str) -> None:
    one, other = first.load_scenario(name), load_scenario(name)
    columns = first.QUANTITY.columns(one.sample(200, 7).worlds)
    columns.pop("obstacle_gap_m", None)
    try:
        old = as_state(first_from_table(one, columns))
    except InvalidInput as error:
        with pytest.raises(InvalidInput) as refusal:
            worlds_from_table(other, columns)
        assert str(refusal.value) == str(error) or other.members  # the second edition says first that it is a mixture
        return
    new = worlds_from_table(other, columns)
    for expected, array in zip(old, (new.line, new.car, new.know), strict=True):
        assert expected.tobytes() == array.tobytes()


@pytest.mark.parametrize("name", SHIPPED)
def test_bounds__are_those_of_the_first_edition(name: str) -> None:
    for key in first.QUANTITY.usual:
        assert load_scenario(name).bounds(key) == first.load_scenario(name).bounds(key)
