"""Ranges of training: their ends, what is outside, and files with bad ones."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError

from ethbrake_marl.errors import CorruptBundle
from ethbrake_marl.policies.bundle import load_policy, load_shipped, shipped_policies
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


def test_policy__keeps_its_range_in_its_file(tmp_path: Path) -> None:
    policy = make_policy()
    size = len(policy.observation.features)
    ranged = policy.with_range(TrainingRange(low=(0.0,) * size, high=(1 / 3,) * size))
    assert policy.manifest.training_range is None and "training_range" not in policy.manifest.model_dump()
    ranged.save(tmp_path / "a")
    assert load_policy(tmp_path / "a").manifest == ranged.manifest != policy.manifest
    assert ranged.with_range(None).manifest == policy.manifest


def test_shipped_policies__have_a_range() -> None:
    assert {"ppo", "sac"} <= shipped_policies().keys()
    assert load_shipped("ppo").manifest.training_range is not None
    assert load_shipped("sac").manifest.training_range is not None


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"low": (0.0,), "high": (1.0,)}, "training_range: has 1 features; must have"),
        ({"low": (0.0, 1.0), "high": (1.0,)}, "training_range: low, high: must have one number for each feature, low"),
    ],
)
def test_bad_range__is_refused(change: dict[str, Any], text: str, tmp_path: Path) -> None:
    policy, bad = make_policy(), TrainingRange.model_construct(**change)
    with pytest.raises(ValidationError, match=re.escape(text.removeprefix("training_range: "))):
        policy.with_range(bad)
    replace(policy, manifest=policy.manifest.model_copy(update={"training_range": bad})).save(tmp_path / "a")
    with refused(text, CorruptBundle):
        load_policy(tmp_path / "a")
