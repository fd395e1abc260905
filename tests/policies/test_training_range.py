"""Ranges of training: their ends, what is outside, and files with bad ones."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError

from ethbrake_marl.episode.features import FEATURES, register_feature
from ethbrake_marl.episode.state import State
from ethbrake_marl.errors import CorruptBundle
from ethbrake_marl.motion.layout import Floats
from ethbrake_marl.policies.bundle import load_policy
from ethbrake_marl.policies.training_range import TrainingRange
from tests.policies.test_bundles import make_policy
from tests.refused import refused

FOUR = TrainingRange(low=(0.0,) * 4, high=(1.0,) * 4)


def test_range__leaves_out_a_thousandth_at_each_end() -> None:
    observations = np.column_stack([np.arange(2001), -np.arange(2001)]).astype(np.float32)
    assert TrainingRange.of(observations) == TrainingRange(low=(2.0, -1998.0), high=(1998.0, -2.0))


def test_outside__three_features_by_more_than_the_margin() -> None:
    observations = np.full((4, 4), 0.5, np.float32)
    observations[0, :2] = 2.0  # two features
    observations[1, :3] = 2.0, -1.0, 1.06
    observations[2, :3] = 2.0, -1.0, 1.04  # the third within the margin
    observations[3] = -0.06
    assert FOUR.is_outside(observations).tolist() == [False, True, False, True]


def brakes_fully(state: State, body: int) -> Floats:
    """Full braking as an action."""
    return np.full(state.n, -1.0)


def test_policy__keeps_its_range_in_its_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(FEATURES, "loaded", dict(FEATURES.loaded))
    register_feature("brakes_fully", brakes_fully, unit="1", scale=1.0, low=-1.0, high=1.0)
    policy = make_policy()
    size = len(policy.observation.features)
    ranged = policy.with_range(TrainingRange(low=(0.0,) * size, high=(1 / 3,) * size, fallback="brakes_fully"))
    assert policy.manifest.training_range is None and "training_range" not in policy.manifest.model_dump()
    ranged.save(tmp_path / "a")
    assert load_policy(tmp_path / "a").manifest == ranged.manifest != policy.manifest
    assert ranged.with_range(None).manifest == policy.manifest


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"low": (0.0,), "high": (1.0,)}, "training_range: has 1 features; must have"),
        ({"low": (0.0, 1.0), "high": (1.0,)}, "training_range: low, high: must have one number for each feature, low"),
        ({"low": (0.0,), "high": (1.0,), "fallback": "plan.actoin"}, "unknown feature 'plan.actoin'"),
        (
            {"low": (0.0,), "high": (1.0,), "fallback": "front_1.gap"},
            "training_range: fallback = front_1.gap: must be an action: a feature of unit 1 and scale 1",
        ),
    ],
)
def test_bad_range__is_refused(change: dict[str, Any], text: str, tmp_path: Path) -> None:
    policy, bad = make_policy(), TrainingRange.model_construct(**change)
    with pytest.raises(ValidationError, match=re.escape(text.removeprefix("training_range: "))):
        policy.with_range(bad)
    replace(policy, manifest=policy.manifest.model_copy(update={"training_range": bad})).save(tmp_path / "a")
    with refused(text, CorruptBundle):
        load_policy(tmp_path / "a")
