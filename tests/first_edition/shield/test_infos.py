"""What the infos say of the shield, read as a user reads them: those of an episode's first and of its last moment."""

from collections.abc import Callable, Iterator
from functools import cache
from itertools import islice, product
from typing import Any, NamedTuple

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.vector import AutoresetMode, SyncVectorEnv

import ethbrake_marl.first_edition as eb

PUSH = np.ones(1, np.float32)  # what is proposed in every last step is this or its opposite
ROWS = 16


class Episode(NamedTuple):
    """The first and the last infos of one agent in one episode."""

    first: dict[str, Any]
    last: dict[str, Any]


def drawn(rng: np.random.Generator, *shape: int) -> np.ndarray:
    """Full driving or full braking, by chance."""
    return rng.choice([-1.0, 1.0], shape).astype(np.float32)


def parallel(**options: Any) -> Iterator[Episode]:
    env, rng = eb.shield(eb.parallel_env(), **options), np.random.default_rng(0)
    _, infos = env.reset(seed=7)
    while True:
        first = infos["vehicle_2"]
        while env.agents:
            infos = env.step({"vehicle_2": drawn(rng, 1)})[4]
        yield Episode(first, infos["vehicle_2"])
        _, infos = env.reset()


def aec(**options: Any) -> Iterator[Episode]:
    env, rng = eb.shield(eb.env(), **options), np.random.default_rng(0)
    env.reset(seed=7)
    while True:
        first, info = env.infos["vehicle_2"], {}
        for agent in env.agent_iter():
            *_, terminated, truncated, told = env.last()
            info = told if agent == "vehicle_2" else info
            env.step(drawn(rng, 1) if agent == "vehicle_2" and not (terminated or truncated) else None)
        yield Episode(first, info)
        env.reset()


def single(**options: Any) -> Iterator[Episode]:
    env, rng = eb.shield(gymnasium.make("EthBrake-v1"), **options), np.random.default_rng(0)
    _, info = env.reset(seed=7)
    while True:
        first, over = info, False
        while not over:
            *_, terminated, truncated, info = env.step(drawn(rng, 1))
            over = terminated or truncated
        yield Episode(first, info)
        _, info = env.reset()


def autoreset(**options: Any) -> Iterator[Episode]:
    env = eb.shield(gymnasium.wrappers.Autoreset(gymnasium.make("EthBrake-v1")), **options)
    rng = np.random.default_rng(0)
    _, info = env.reset(seed=7)
    while True:
        first, over = info, False
        while not over:
            *_, terminated, truncated, info = env.step(drawn(rng, 1))
            over = terminated or truncated
        yield Episode(first, info)
        *_, info = env.step(drawn(rng, 1))  # which begins the next one


def of_row(infos: dict[str, Any], k: int) -> dict[str, Any]:
    """Row k of vector infos, as far as its masks are set."""
    return {name: told[k] for name, told in infos.items() if not name.startswith("_") and infos[f"_{name}"][k]}


def batch(env: Any) -> Iterator[Episode]:
    """Of any vector environment, in both autoreset modes."""
    rng, mode = np.random.default_rng(0), env.metadata["autoreset_mode"]
    infos = env.reset(seed=7)[1]
    first, over = [of_row(infos, k) for k in range(env.num_envs)], np.zeros(env.num_envs, bool)
    while True:
        begins = over
        *_, terminated, truncated, infos = env.step(drawn(rng, env.num_envs, 1))
        over = terminated | truncated
        if mode is AutoresetMode.SAME_STEP:
            begins, final = over, infos.pop("final_info", {})
            infos = {name: told for name, told in infos.items() if "final" not in name}
        for k in np.flatnonzero(over):
            yield Episode(first[k], of_row(infos if mode is AutoresetMode.NEXT_STEP else final, k))
        for k in np.flatnonzero(begins):
            first[k] = of_row(infos, k)


def vector(mode: str) -> Callable[..., Iterator[Episode]]:
    return lambda **options: batch(eb.shield(eb.EthBrakeVectorEnv(ROWS, autoreset_mode=mode), **options))


def sync(mode: str) -> Callable[..., Iterator[Episode]]:
    def make(**options: Any) -> Iterator[Episode]:
        one = lambda: eb.shield(gymnasium.make("EthBrake-v1"), **options)  # noqa: E731
        return batch(SyncVectorEnv([one] * 3, autoreset_mode=AutoresetMode(mode)))

    return make


def rows(env: Any) -> Iterator[Episode]:
    """Of any ``VecEnv``."""
    rng = np.random.default_rng(0)
    env.seed(7)
    env.reset()
    first = list(env.reset_infos)
    while True:
        _, _, dones, infos = env.step(drawn(rng, env.num_envs, 1))
        for k in np.flatnonzero(dones):
            yield Episode(first[k], infos[k])
            first[k] = env.reset_infos[k]


def sb3(**options: Any) -> Iterator[Episode]:
    return rows(eb.shield(eb.make_sb3_vec_env("paper-random", ROWS), **options))


INTERFACES = {
    "parallel": parallel,
    "aec": aec,
    "gymnasium": single,
    "vector, SameStep": vector("SameStep"),
    "vector, NextStep": vector("NextStep"),
    "sb3": sb3,
}
THEIR_OWN = {  # resets by somebody else's hand
    "Autoreset": autoreset,
    "SyncVectorEnv, SameStep": sync("SameStep"),
    "SyncVectorEnv, NextStep": sync("NextStep"),
}
BRAKED = eb.make_agent("full_brake")
MODES: dict[str, dict[str, Any]] = {"step": {"shares": True}, "episode": {"mode": "episode", "policy": BRAKED}}
CODES = {"episode": 0, "step": 1}


ONE_WORLD = {"parallel", "aec", "gymnasium", *THEIR_OWN}  # these take a second for 24 episodes


def episodes(interface: str, **options: Any) -> Iterator[Episode]:
    """Some episodes of an interface."""
    return islice((INTERFACES | THEIR_OWN)[interface](**options), 8 if interface in ONE_WORLD else 24)


@cache
def alert_bounds(**options: Any) -> dict[int, float]:
    """The bounds reported at the alerts of the first worlds of stream 7, by their number, in 64 rows."""
    env = eb.shield(eb.EthBrakeVectorEnv(64), **options)
    infos = env.reset(seed=7)[1]
    return dict(zip(infos["world"].tolist(), infos["shield_bound_harm"].tolist(), strict=True))


def above(played: Iterator[Episode]) -> int:
    """In how many episodes the line bore more than the bound reported at the alert."""
    return sum(last["world_first_impact_harm"] > first["shield_bound_harm"] + 1e-9 for first, last in played)


@pytest.mark.parametrize("interface", [*INTERFACES, *THEIR_OWN])
def test_harm__is_at_most_the_bound_reported_at_the_alert(interface: str) -> None:
    assert above(episodes(interface)) == 0


@pytest.mark.parametrize(("interface", "mode"), [*product(INTERFACES, MODES), *product(THEIR_OWN, ["step"])])
def test_infos__of_the_first_moment_and_of_the_last_belong_to_their_episode(interface: str, mode: str) -> None:
    for first, last in belonging(interface, CODES[mode], MODES[mode]):
        if mode != "episode":
            assert first["shield_reason"] == eb.ShieldReason.NO_DECISION != last["shield_reason"]
        if mode == "step":
            assert last["shield_bound_harm"] == pytest.approx(last["world_first_impact_harm"], abs=1e-9)
            assert last["shield_own_harm"] == last["first_impact_harm"]


def belonging(interface: str, code: int, options: dict[str, Any]) -> Iterator[Episode]:
    """Some episodes in a mode, looked at: infos belong to their episode."""
    shares_stream = "Sync" not in interface  # whose copies have streams of their own
    for first, last in episodes(interface, **options):
        assert first["world"] == last["world"] and first["world_seed"] == last["world_seed"]
        assert not shares_stream or first["shield_bound_harm"] == alert_bounds(**options)[first["world"]]
        assert last["shield_bound_harm"] <= first["shield_bound_harm"]
        assert first["shield_proposed_action"] == first["shield_applied_action"] == 0.0
        assert not first["shield_intervened"] and abs(last["shield_proposed_action"]) == 1.0
        assert last["shield_applied_action"] == pytest.approx(last["chosen_action"].item(), abs=1e-6)
        assert first["shield_mode"] == code
        yield first, last


@pytest.mark.parametrize("agents", ["all", "learners"])
@pytest.mark.parametrize("settings", [{}, {"shares": True}, {"cap": "baseline", "allowance": 1.0}])
def test_infos__are_flat_numbers_with_the_same_keys_for_every_agent_at_all_times(agents: str, settings: Any) -> None:
    env = eb.shield(eb.parallel_env("cooperation-3-pair", agents=agents), **settings)
    _, infos = env.reset(seed=3)
    keys = set(infos["vehicle_2"])
    assert {name for name in keys if name.startswith("shield_")} > {"shield_mode", "shield_reason", "shield_bound_harm"}
    while env.agents:
        for agent, info in infos.items():
            assert set(info) == keys
            assert all(torch.as_tensor(value).ndim <= 1 for value in info.values())  # what TorchRL makes of them
            if agent == "vehicle_1":  # which follows a script
                assert info["shield_reason"] == eb.ShieldReason.NO_DECISION and not info["shield_intervened"]
                assert info["shield_bound_harm"] == infos["vehicle_2"]["shield_bound_harm"]
        infos = env.step({"vehicle_2": PUSH, "vehicle_3": -PUSH})[4]


def test_codes__are_those_of_the_texts_in_the_engines_record() -> None:
    env = eb.shield(eb.EthBrakeVectorEnv(64))
    env.reset(seed=7)
    rng, seen = np.random.default_rng(0), set()
    for _ in range(80):
        infos = env.step(drawn(rng, 64, 1))[4]
        texts = env.unwrapped.engine.ruling.decision.reason_names
        for k, code in enumerate(infos["shield_reason"].tolist()):
            if code != eb.ShieldReason.NO_DECISION:
                assert eb.ShieldReason(code).text == texts[k]
                seen.add(code)
    assert {eb.ShieldReason.PLAN_REMAINS, eb.ShieldReason.NO_CERTIFICATE} <= seen
