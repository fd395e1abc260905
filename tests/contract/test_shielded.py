"""Behind the shield every interface keeps the promises of the bare one, and the libraries' own checkers pass."""

from __future__ import annotations

import copy
import pickle
import warnings
from collections.abc import Callable, Iterator
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode
from pettingzoo.test import api_test, parallel_api_test, parallel_seed_test, seed_test
from stable_baselines3.common.env_checker import check_env as sb3_check_env

from ethbrake_marl.agents.registry import make_agent
from ethbrake_marl.envs.interfaces import EthBrakeVectorEnv, UnknownResetOption, parallel_env
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.shield import HybridShield, ShieldedEnv, ShieldedVectorEnv, shielded_aec
from tests.contract import interfaces, test_contract as bare
from tests.contract.interfaces import PAPER, actions
from tests.contract.shielded import SHIELDED, STEP

MODES: dict[str, dict[str, Any]] = {"step": {"mode": "step"}, "episode": {"policy": make_agent("full_brake")}}
PROMISES: tuple[Callable[[str], None], ...] = (
    bare.test_seed__starts_its_stream_again_whatever_happened_before,
    bare.test_seed__different_seeds_differ,
    bare.test_seed__without_one_the_stream_goes_on,
    bare.test_seed__an_environment_that_was_never_seeded_uses_fresh_entropy,
    bare.test_arrays__what_was_returned_never_changes_and_may_be_overwritten,
    bare.test_actions__are_left_alone,
    bare.test_truncated__marks_the_horizon_and_nothing_else,
    bare.test_terminated__marks_the_moment_when_all_rest,
    bare.test_terminated__at_the_horizon_itself_is_not_truncated,
    bare.test_action__of_another_shape_is_refused,
    bare.test_step__before_the_first_reset_is_refused,
    bare.test_options__an_unknown_one_warns_and_is_ignored,
    bare.test_options__an_initial_state_serves_one_episode_in_every_world,
)


pytestmark = pytest.mark.filterwarnings("ignore::ethbrake_marl.shield.MovingAtHorizon")


@pytest.fixture(autouse=True)
def _shielded_interfaces(monkeypatch: pytest.MonkeyPatch) -> None:
    for name, interface in SHIELDED.items():
        monkeypatch.setitem(interfaces.INTERFACES, name, interface)  # type: ignore[arg-type]
    batched = ("shielded vector", "shielded sb3")
    monkeypatch.setattr(interfaces, "BATCHED", (*interfaces.BATCHED, *batched))


@pytest.fixture
def _no_warnings() -> Iterator[None]:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.filterwarnings("ignore", "reset: unknown option options, ignored", UnknownResetOption)
        warnings.filterwarnings("ignore", ".*is different from the unwrapped version")  # it is: that is the wrapper
        yield


@pytest.mark.parametrize("promise", PROMISES, ids=lambda promise: promise.__name__.removeprefix("test_"))
@pytest.mark.parametrize("name", SHIELDED)
def test_promise__holds_behind_the_shield(name: str, promise: Callable[[str], None]) -> None:
    promise(name)


@pytest.mark.parametrize("name", SHIELDED)
def test_seed__repeats_whole_episodes_bit_for_bit(name: str) -> None:
    bare.test_seed__repeats_whole_episodes_bit_for_bit(name, PAPER)


@pytest.mark.parametrize("name", SHIELDED)
def test_observation__lies_in_its_space_at_every_step(name: str) -> None:
    bare.test_observation__lies_in_its_finite_float32_space_at_every_step(name, PAPER)


@pytest.mark.parametrize("clone", [copy.deepcopy, lambda env: pickle.loads(pickle.dumps(env))], ids=["copy", "pickle"])
@pytest.mark.parametrize("name", SHIELDED)
def test_clone__in_mid_episode_goes_on_alike_and_apart(name: str, clone: Any) -> None:
    bare.test_clone__in_mid_episode_goes_on_alike_and_apart(name, PAPER, clone)


@pytest.mark.parametrize(("value", "message"), [(np.nan, "nan; must be in"), (1.001, r"1\.001"), ("full", "not a num")])
@pytest.mark.parametrize("name", SHIELDED)
def test_action__that_cannot_be_used_is_refused_and_changes_nothing(name: str, value: Any, message: str) -> None:
    bare.test_action__one_that_cannot_be_used_is_refused_and_changes_nothing(name, value, message)


def test_interfaces__agree_behind_the_shield_and_differ_from_the_bare_ones() -> None:
    runs = {name: [turn.bits() for turn in bare.play(interface(PAPER, 1), 7)] for name, interface in STEP.items()}
    expected = runs["shielded single"]
    assert all(run == expected for run in runs.values())
    assert [turn.bits() for turn in bare.play(interfaces.INTERFACES["single"](PAPER, 1), 7)] != expected


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.usefixtures("_no_warnings")
def test_pettingzoo__checkers_pass(mode: str) -> None:
    given = MODES[mode]
    parallel_api_test(HybridShield(parallel_env(), **given), num_cycles=100)
    api_test(shielded_aec(parallel_env(), **given), num_cycles=100)
    parallel_seed_test(lambda: HybridShield(parallel_env(), **given), num_cycles=20)
    seed_test(lambda: shielded_aec(parallel_env(), **given), num_cycles=20)


@pytest.mark.usefixtures("_no_warnings")
def test_gymnasium_and_stable_baselines3__checkers_pass() -> None:
    plain = gymnasium.make("EthBrake-v0").unwrapped
    check_env(ShieldedEnv(plain), skip_render_check=True)
    sb3_check_env(ShieldedEnv(gymnasium.make("EthBrake-v0").unwrapped))


@pytest.mark.parametrize("mode", [AutoresetMode.SAME_STEP, AutoresetMode.NEXT_STEP])
def test_vector__keeps_each_rows_bound_whatever_the_autoreset_mode(mode: AutoresetMode) -> None:
    env = ShieldedVectorEnv(EthBrakeVectorEnv(6, PAPER, autoreset_mode=mode), intervention_penalty=5.0)
    env.reset(seed=3)
    ended, penalised = 0, 0
    for action in actions(5, 120, 6):
        idle, bound = env.attached.engine.ended, env.attached.shield.first_bound.copy()
        _, reward, terminated, truncated, infos = env.step(np.abs(action))
        told, over = infos["shield"], terminated | truncated
        assert infos["_shield"].tolist() == (~idle).tolist() and told["trusted"].all()
        final = infos["final_info"] if mode is AutoresetMode.SAME_STEP and over.any() else infos
        harm = final["world_first_impact_harm"][over]
        assert harm.tolist() == told["bound_harm"][over].tolist()
        assert (harm <= bound[over]).all()
        penalised += int((told["intervened"] & ~idle).sum())
        assert (reward[told["intervened"] & ~idle] <= -5.0).all()
        ended += int(over.sum())
    assert ended >= 6 and penalised > 0


def test_vector__refuses_what_is_no_vector_environment_of_ours() -> None:
    with pytest.raises(InvalidInput, match="is not one of this package's environments"):
        ShieldedVectorEnv(parallel_env())


def test_vector__closed_lets_go_of_the_environment() -> None:
    env = EthBrakeVectorEnv(2, PAPER)
    ShieldedVectorEnv(env).close()
    assert env.engine.guard is None
