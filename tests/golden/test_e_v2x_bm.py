"""Golden values of the E-V2X-BM closed form: five settings with a1 = a3 = 6 and a2 <= 7 m/s2."""

import numpy as np
import pytest

from ethbrake_marl.first_edition.agents.e_v2x_bm.pairwise import optimise_pairwise, pairwise_harm
from ethbrake_marl.first_edition.physics.state import Worlds, make_worlds


def paper_world(gaps_m: tuple[float, ...], speeds_mps: tuple[float, ...], tau2: float, tau3: float) -> Worlds:
    return make_worlds(
        gaps_m,
        speeds_mps,
        braking_capacity_mps2=[6, 7, 6],
        driving_capacity_mps2=[6, 7, 6],
        latency_s=[0, tau2, tau3],
        mass_t=[4.5, 5.5, 5.9],
        restitution=0.1,
    )


# gaps; speeds; tau2, tau3; interval ends; a*, H*; harm of full braking; each as printed. The last H* was printed as
# 22.2623, which is the harm at the *printed* a* = 6.24679 (tested below); at the minimum it is 22.26221: the front pair
# is spared from a = 18^2 / (2 (7 + 400/12 - 18 * 0.8)) = 6.2467866, and there the rear pair meets with 11.76 a - 51.2.
GOLDEN = [
    ((10, 8), (20, 18, 20), (0.5, 0.8), ("4.71845", "5.01031"), (None, "0"), "28.98"),
    ((5, 9), (22, 18, 20), (0.5, 0.8), ("4.45872", "5.17021"), (None, "0"), "30.98"),
    ((7, 7), (20, 18, 20), (0.5, 0.8), ("5.17021", "4.84848"), ("5.17021", "4.03447"), "26.98"),
    ((7, 7), (20, 18, 20), (0.2, 0.8), None, ("4.41016", "6.94011"), "46.72"),
    ((7, 7), (20, 18, 20), (0.8, 1.2), None, ("6.24679", "22.2622"), "31.12"),
]


def as_printed(value: float, printed: str) -> str:
    """The number with as many digits as are printed."""
    digits = len(printed.partition(".")[2])
    return f"{value:.{digits}f}"


@pytest.mark.parametrize(("gaps", "speeds", "latency", "ends", "optimum", "full"), GOLDEN)
def test_closed_form__golden_row_to_every_printed_digit(gaps, speeds, latency, ends, optimum, full):
    world = paper_world(gaps, speeds, *latency)
    deceleration, harm, low, high = (column[0] for column in optimise_pairwise(world, 1)[:4])
    found = [low, high, deceleration, harm, pairwise_harm(world, [6, 7, 6]).sum()]
    for value, printed in zip(found, (*(ends or (None, None)), *optimum, full), strict=True):
        assert printed is None or as_printed(value, printed) == printed
    assert ends is not None or low > min(high, 7.0)
    assert optimum[0] is not None or deceleration == 0.5 * (low + high)


def test_closed_form__one_call_gives_the_same_bits_as_five():
    worlds = [paper_world(gaps, speeds, *latency) for gaps, speeds, latency, *_ in GOLDEN]
    from_batch = optimise_pairwise(Worlds.concatenate(worlds), 1)
    for k, world in enumerate(worlds):
        for column, own in zip(from_batch, optimise_pairwise(world, 1), strict=True):
            np.testing.assert_array_equal(column[k], own[0])


def test_closed_form__the_last_printed_harm_is_that_at_its_printed_deceleration():
    world = paper_world((7, 7), (20, 18, 20), 0.8, 1.2)
    assert as_printed(pairwise_harm(world, [6, 6.24679, 6]).sum(), "22.2623") == "22.2623"
    by_hand = 18**2 / (2 * (7 + 400 / 12 - 18 * 0.8))
    found = optimise_pairwise(world, 1)
    assert found.deceleration_mps2[0] == pytest.approx(by_hand, abs=1e-12)
    assert found.harm[0] == pytest.approx(11.76 * by_hand - 51.2, abs=1e-12)
