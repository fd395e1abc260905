"""A training over a mixture of scenarios: it goes on after a stop to the same bits, from its own folder."""

from __future__ import annotations

import csv
import json
import os
import signal
from pathlib import Path
from typing import Any

import pytest

import ethbrake_marl as eb
from ethbrake_marl.envs.sb3 import EthBrakeVecEnv, make_sb3_vec_env
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.learning import runs as train_module
from ethbrake_marl.learning.runs import resume, train
from ethbrake_marl.learning.training import RunDirectory, Training
from ethbrake_marl.scenario import load_scenario
from tests.learning.tiny import TINY_PPO

RECIPE = TINY_PPO.replace(total_steps=8 * 128)
MIXTURE = load_scenario(
    {"name": "both", "mixture": [{"scenario": "realistic-mixed"}, {"scenario": "realistic-truck", "weight": 2}]}
)


def weights(run: Path) -> bytes:
    return (run / "policy-last" / "weights.safetensors").read_bytes()


class Stopped(EthBrakeVecEnv):
    """Is interrupted in its 70th step."""

    count = 0

    def step_wait(self) -> tuple[Any, ...]:
        self.count += 1
        if self.count == 70:
            os.kill(os.getpid(), signal.SIGINT)
        return super().step_wait()


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_training__goes_on_to_the_same_bits(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    whole = train(RECIPE, MIXTURE, tmp_path / "whole")

    def make(*args: Any, **kwargs: Any) -> EthBrakeVecEnv:
        environment = make_sb3_vec_env(*args, **kwargs)
        environment.__class__ = Stopped
        return environment

    with monkeypatch.context() as patch:
        patch.setattr(train_module, "make_sb3_vec_env", make)
        assert train(RECIPE, MIXTURE, tmp_path / "run").status == "interrupted"
    again = resume(tmp_path / "run")
    assert (again.status, again.steps) == ("finished", whole.steps)
    assert weights(tmp_path / "run") == weights(tmp_path / "whole")
    assert again.evaluations == whole.evaluations

    config = json.loads((tmp_path / "run" / "config.json").read_text())
    kept = RunDirectory(tmp_path / "run").training(config)  # from its own file alone
    assert kept.scenario == MIXTURE
    RunDirectory(tmp_path / "run").check_same(Training.of(RECIPE, MIXTURE))
    with pytest.raises(InvalidInput, match="holds another training"):
        RunDirectory(tmp_path / "run").check_same(Training.of(RECIPE, load_scenario("realistic-truck")))

    policy = eb.load_policy(tmp_path / "run")
    agents = {"mine": eb.LearnedAgent(policy), "full_brake": eb.make_agent("full_brake")}
    found = eb.evaluate(MIXTURE.sample(40, 7), agents, scenario=MIXTURE, seed=7)
    assert set(eb.summarise_by(found, "scenario")) == {"realistic-mixed", "realistic-truck"}
    rows = list(csv.DictReader((tmp_path / "run" / "progress.csv").read_text().splitlines()))
    assert rows
