from __future__ import annotations

import pytest

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.scenario.fields import constant_command, is_state_free, parse_agent_spec


@pytest.mark.parametrize(
    ("spec", "parts"),
    [
        ("full_brake", ("full_brake", None)),
        ("constant:3.5", ("constant", "3.5")),
        ("e_v2x_bm:pairwise", ("e_v2x_bm", "pairwise")),
        ("learned:runs/my-run", ("learned", "runs/my-run")),
        ("policy@best.v1-a:b:c", ("policy@best.v1-a", "b:c")),
    ],
)
def test_spec__splits_at_the_first_colon(spec, parts):
    assert parse_agent_spec(spec) == parts


@pytest.mark.parametrize(
    "spec", ["", "Full_brake", "2fast", "full brake", "constant:", ":3", "constant: 3", "a\n", 3, None]
)
def test_spec__bad_syntax_is_refused_with_an_example(spec):
    with pytest.raises(InvalidInput, match=r"must be name or name:argument.*constant:3\.5"):
        parse_agent_spec(spec)


def test_constant_command__of_each_state_free_script():
    assert constant_command("full_brake", [6.0, 7.0]).tolist() == [-6.0, -7.0]
    assert constant_command("coast", [6.0, 7.0]).tolist() == [0.0, 0.0]
    assert constant_command("constant:3.5", [6.0, 7.0]).tolist() == [-3.5, -3.5]
    assert constant_command("constant:-2", [6.0, 7.0], [2.0, 3.0]).tolist() == [2.0, 2.0]
    assert constant_command("constant:6", [6.0, 7.0]).tolist() == [-6.0, -6.0]


def test_constant_command__of_another_script_is_none():
    assert constant_command("e_v2x_bm:pairwise", [6.0]) is None
    assert not is_state_free("e_v2x_bm")
    assert is_state_free("coast")


@pytest.mark.parametrize(
    ("spec", "reason"),
    [
        ("constant:6.01", "braking capacity 6 m/s2"),
        ("constant:-2.01", "driving capacity 2 m/s2"),
        ("constant:nan", "finite deceleration"),
        ("constant:inf", "finite deceleration"),
        ("constant:hard", "finite deceleration"),
        ("constant", "finite deceleration"),
        ("full_brake:3", "takes no argument"),
        ("coast:0", "takes no argument"),
    ],
)
def test_constant_command__what_cannot_be_done_is_an_error(spec, reason):
    with pytest.raises(InvalidInput, match=reason) as caught:
        constant_command(spec, [7.0, 6.0], [3.0, 2.0])
    assert repr(spec) in str(caught.value)
