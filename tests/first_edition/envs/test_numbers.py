"""What looks like a number and is none is refused in one line: truth values, masked entries, tensors with gradients."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch

import ethbrake_marl.first_edition as eb
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.first_edition.scenario.tables import worlds_from_table

Make = Callable[[float], Any]
BAD: dict[str, tuple[Make, str]] = {
    "truth": (bool, "is a boolean"),
    "numpy truth": (np.bool_, "is a boolean"),
    "truths": (lambda x: np.array(bool(x)), "is a boolean"),
    "tensor of a truth": (lambda x: torch.tensor(bool(x)), "is a boolean"),
    "masked": (lambda x: np.ma.masked, "is masked"),
    "masked array": (lambda x: np.ma.array(x, mask=True), "is masked"),
    "gradient": (lambda x: torch.tensor(x, requires_grad=True), r"requires gradients; pass tensor\.detach\(\)"),
    "parameter": (lambda x: torch.nn.Parameter(torch.tensor(x)), "requires gradients"),
    "elsewhere": (lambda x: torch.zeros((), device="meta"), "is not a number"),
    "half": (lambda x: torch.tensor(x, dtype=torch.bfloat16), "is not a number"),
    "text": (str, "is not a number"),
    "complex": (complex, "is not a number"),
    "nothing": (lambda x: {}, "is not a number"),
}
each_bad = pytest.mark.parametrize("bad", BAD)


def shapes(make: Make, x: float, rows: int) -> list[Any]:
    """One bad value among ``rows`` rows of good ones, as lists and, where such exist, as one array."""
    bad = make(x)
    lists = [[bad, *[x] * (rows - 1)], [*[[x]] * (rows - 1), [bad]]] if rows > 1 else [bad, [bad], (bad,)]
    if isinstance(bad, torch.Tensor):
        return [*lists, torch.stack([bad] * rows), torch.stack([bad] * rows)[:, None]]
    if isinstance(bad, np.ma.MaskedArray):
        mask = [True, *[False] * (rows - 1)]
        return [*lists, np.ma.array([x] * rows, mask=mask), np.ma.array([[x]] * rows, mask=[[m] for m in mask])]
    if isinstance(bad, bool | np.bool_):
        return [*lists, np.array([bad] * rows), np.array([bad, *[x] * (rows - 1)], object)]
    return lists


def started(env: Any) -> Any:
    env.reset()
    return env


def acting(env: Any) -> Any:
    """An AEC environment in which the learner's turn has come."""
    env.reset()
    env.step(None)
    return env


ONE: dict[str, tuple[Callable[[], Any], Callable[[Any, Any], Any]]] = {
    "parallel": (lambda: started(eb.parallel_env()), lambda env, a: env.step({"vehicle_2": a})),
    "shielded": (lambda: started(eb.shield(eb.parallel_env())), lambda env, a: env.step({"vehicle_2": a})),
    "in turn": (lambda: acting(eb.env()), lambda env, a: env.step(a)),
    "single": (lambda: started(eb.EthBrakeEnv()), lambda env, a: env.step(a)),
}
MANY: dict[str, tuple[Callable[[], Any], Callable[[Any, Any], Any]]] = {
    "vector": (lambda: started(eb.EthBrakeVectorEnv(3)), lambda env, a: env.step(a)),
    "shielded vector": (lambda: started(eb.shield(eb.EthBrakeVectorEnv(3))), lambda env, a: env.step(a)),
    "sb3": (lambda: started(eb.make_sb3_vec_env("paper-random", 3)), lambda env, a: env.step(a)),
    "engine": (lambda: eb.make_engine("paper-random", 3), lambda engine, a: engine.step(a)),
    "engine, by index": (lambda: eb.make_engine("paper-random", 3), lambda engine, a: engine.step({1: a})),
}


@each_bad
@pytest.mark.parametrize("name", [*ONE, *MANY])
def test_action__that_is_no_number_is_refused(name: str, bad: str) -> None:
    make, message = BAD[bad]
    env, step = (ONE | MANY)[name][0](), (ONE | MANY)[name][1]
    for action in shapes(make, 0.5, 1 if name in ONE else 3):
        with pytest.raises(InvalidInput, match=rf"action of (vehicle_2|the learners): (?s:.*){message}"):
            step(env, action)
    step(env, 0.5 if name in ONE else [0.5] * 3)


@each_bad
def test_metres__that_are_no_number_are_refused(bad: str) -> None:
    make, message = BAD[bad]
    settings = dict.fromkeys(("braking_capacity_mps2", "driving_capacity_mps2", "mass_t"), 2.0)
    for gaps in [make(7.0), *shapes(make, 7.0, 2)]:
        state = {"gaps_m": gaps, "speeds_mps": 20}
        with pytest.raises(InvalidInput, match=rf"^initial_state: gaps_m = (?s:.*){message}"):
            eb.EthBrakeEnv().reset(options={"initial_state": state})
        with pytest.raises(InvalidInput, match=rf"^gaps_m: (?s:.*){message}"):
            eb.make_worlds(gaps, [20.0, 20.0, 20.0], **settings, latency_s=0, restitution=0)
    table = {"gap_1_m": [7.0, make(7.0)], "gap_2_m": [7.0, 7.0], **{f"speed_{i}_mps": [20.0, 20.0] for i in (1, 2, 3)}}
    with pytest.raises(InvalidInput, match=rf"^initial states: gap_1_m = (?s:.*){message}"):
        worlds_from_table(eb.load_scenario("paper-random"), table)


GOOD: dict[str, Make] = {
    "number": float,
    "numpy number": np.float32,
    "nothing masked": lambda x: np.ma.array(x, mask=False),
    "tensor": torch.tensor,
    "detached": lambda x: torch.tensor(x, requires_grad=True).detach(),
    "object": lambda x: np.array(x, object),
}


@pytest.mark.parametrize("good", GOOD)
def test_numbers__of_every_other_make_are_taken(good: str) -> None:
    make = GOOD[good]
    seen = []
    for state in ([7.0, 7.0], [make(7.0), make(7.0)]):
        env = eb.EthBrakeEnv()
        start = env.reset(options={"initial_state": {"gaps_m": state, "speeds_mps": make(20.0)}})[0]
        seen.append((start.tobytes(), env.step(make(-0.5))[0].tobytes(), env.step([make(-0.5)])[0].tobytes()))
    assert seen[0] == seen[1]
    rows, plain = (started(eb.make_sb3_vec_env("paper-random", 2, seed=1)) for _ in range(2))
    given = [[make(-0.5)], [make(0.5)]]
    assert np.array_equal(rows.step(given)[0], plain.step(np.array([[-0.5], [0.5]]))[0])
