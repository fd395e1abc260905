from __future__ import annotations

import zipfile
from pathlib import Path

import numpy as np
import pytest
from stable_baselines3 import PPO, SAC

from ethbrake_marl.envs.sb3 import make_sb3_vec_env
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.learning.legacy import import_legacy
from ethbrake_marl.observations import ObservationSpec
from ethbrake_marl.policies.policy import load_policy, save_policy
from ethbrake_marl.scenario import load_scenario

SCENARIO = load_scenario("paper-random")


def _saved(path: Path, algorithm: str, observation: ObservationSpec | None = None) -> PPO | SAC:
    environment = make_sb3_vec_env(SCENARIO, 4, observation=observation)
    small = {"policy_kwargs": {"net_arch": [12, 7]}, "device": "cpu", "seed": 1}
    if algorithm == "ppo":
        model: PPO | SAC = PPO("MlpPolicy", environment, n_steps=8, batch_size=8, **small)
    else:
        model = SAC("MlpPolicy", environment, buffer_size=100, **small)
    model.save(path)
    return model


@pytest.mark.parametrize("algorithm", ["ppo", "sac"])
def test_import_legacy__acts_as_the_saved_model(algorithm: str, tmp_path: Path) -> None:
    model = _saved(tmp_path / "old.zip", algorithm)
    save_policy(import_legacy(tmp_path / "old.zip", SCENARIO, algorithm=algorithm, trusted=True), tmp_path / "new")
    policy = load_policy(tmp_path / "new")
    assert (policy.manifest.algorithm, policy.manifest.network.policy_hidden) == (algorithm, (12, 7))
    assert policy.manifest.network.activation == ("tanh" if algorithm == "ppo" else "relu")
    seen = np.random.default_rng(0).uniform(-2.0, 2.0, (300, 27)).astype(np.float32)
    np.testing.assert_allclose(policy(seen), model.predict(seen, deterministic=True)[0], rtol=0.0, atol=2e-6)


def test_import_legacy__reads_nothing_of_a_file_that_is_not_trusted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(PPO, "load", lambda *a, **k: pytest.fail("the file was read"))
    with pytest.raises(InvalidInput, match=r"runs the code inside it; .* --i-trust-this-file"):
        import_legacy(tmp_path / "is-not-even-there.zip", SCENARIO)


def test_import_legacy__refuses_what_is_not_ours(tmp_path: Path) -> None:
    _saved(tmp_path / "narrow.zip", "ppo", ObservationSpec(1, 0))
    with pytest.raises(InvalidInput, match=r"takes observations of shape \(17,\); ours are \(27,\)"):
        import_legacy(tmp_path / "narrow.zip", SCENARIO, trusted=True)
    (tmp_path / "text.zip").write_text("no archive")
    with pytest.raises(InvalidInput, match=r"text.zip: is no .zip archive"):
        import_legacy(tmp_path / "text.zip", SCENARIO, trusted=True)
    with zipfile.ZipFile(tmp_path / "other.zip", "w") as archive:
        archive.writestr("data", "{}")
    with pytest.raises(InvalidInput, match=r"other.zip: cannot be read as PPO"):
        import_legacy(tmp_path / "other.zip", SCENARIO, trusted=True)
