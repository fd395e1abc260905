from __future__ import annotations

import pytest

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.scenario.sampling import ScriptSpec


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
    assert ScriptSpec.parse(spec) == parts


@pytest.mark.parametrize(
    "spec", ["", "Full_brake", "2fast", "full brake", "constant:", ":3", "constant: 3", "a\n", 3, None]
)
def test_spec__bad_syntax_is_refused_with_an_example(spec):
    with pytest.raises(InvalidInput, match=r"must be name or name:argument.*constant:3\.5"):
        ScriptSpec.parse(spec)


def test_constant_command__of_each_state_free_script():
    assert ScriptSpec.parse("full_brake").command([6.0, 7.0]).tolist() == [-6.0, -7.0]
    assert ScriptSpec.parse("coast").command([6.0, 7.0]).tolist() == [0.0, 0.0]
    assert ScriptSpec.parse("constant:3.5").command([6.0, 7.0]).tolist() == [-3.5, -3.5]
    assert ScriptSpec.parse("constant:-2").command([6.0, 7.0], [2.0, 3.0]).tolist() == [2.0, 2.0]
    assert ScriptSpec.parse("constant:6").command([6.0, 7.0]).tolist() == [-6.0, -6.0]


def test_constant_command__of_another_script_is_none():
    assert ScriptSpec.parse("e_v2x_bm:pairwise").command([6.0]) is None
    assert not ScriptSpec.parse("e_v2x_bm").is_state_free()
    assert ScriptSpec.parse("coast").is_state_free()


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
        ScriptSpec.parse(spec).command([7.0, 6.0], [3.0, 2.0])
    assert repr(spec) in str(caught.value)
