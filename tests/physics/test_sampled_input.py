"""What the paper's fixed-step map refuses."""

from __future__ import annotations

import math

import pytest

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.physics import advance, advance_sampled
from tests.physics.test_sampled import line, paper_random


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda w: advance_sampled(w, [0.0, 0.0, -9.0], until_s=1.0), r"\[0, 2\] = -9: must be in \[-6, 10\] m/s2"),
        (lambda w: advance_sampled(w, [0.0, math.nan, 0.0], until_s=1.0), r"command_mps2\[0, 1\] = nan"),
        (lambda w: advance_sampled(w, [0.0, 0.0], until_s=1.0), r"command_mps2: shape \(2,\) does not fit \(4, 3\)"),
        (lambda w: advance_sampled(w, 0.0, until_s=[1.0, 2.0]), r"until_s: shape \(2,\) does not fit \(4,\)"),
        (lambda w: advance_sampled(w, 0.0, until_s=-1.0), "world 0 is at 0 s and cannot be advanced to -1 s"),
        (lambda w: advance_sampled(w, 0.0, until_s=[1.0, 1.0, math.nan, 1.0]), "world 2 is at 0 s"),
        (lambda w: advance_sampled(w, 0.0, until_s=math.inf), "cannot be advanced to inf s"),
        (lambda w: advance_sampled(w, 0.0, until_s=2000.0, step_s=1e-6), "1,000,000,000 steps"),
        (lambda w: advance_sampled(w, 0.0, until_s=1.0, step_s=0.0), "step_s = 0: must be finite and at least 1e-06 s"),
        (lambda w: advance_sampled(w, 0.0, until_s=1.0, step_s=math.nan), "step_s = nan"),
        (lambda w: advance_sampled(w, 0.0, until_s=1.0, step_s=math.inf), "step_s = inf"),
        (
            lambda w: advance_sampled(advance(w, 0.0, until_s=0.53)[0], 0.0, until_s=1.0),
            r"world 0 is at 0.53 s, between two of its samples 0.5 s \+ n \* 0.1 s",
        ),
    ],
)
def test_bad_input__is_refused_with_its_place_and_range(call, message):
    with pytest.raises(InvalidInput, match=message):
        call(paper_random(4)[0])


def test_bad_input__a_world_that_was_thrown_back_before_its_first_sample():
    worlds = line([0.0], [0.0, 10.0], mass=[4.0, 1.0], e=0.5, latency=[0.0, 0.5])
    thrown, _ = advance(worlds, [0.0, 0.0], 0.1)
    with pytest.raises(InvalidInput, match=r"world 0 has a negative speed at 0.1 s, before its first sample at 0.5 s"):
        advance_sampled(thrown, [0.0, 0.0], until_s=1.0)
