from __future__ import annotations

import pytest

from ethbrake_marl.learning.progress import Course, misleading_return


def _evaluations(returns: list[float], harms: list[float]) -> list[dict[str, float]]:
    pairs = zip(returns, harms, strict=True)
    return [
        {"steps": 100.0 * k, "episode_return": gained, "first_impact_harm": harm}
        for k, (gained, harm) in enumerate(pairs)
    ]


@pytest.mark.parametrize(
    ("returns", "harms", "alarm"),
    [
        ([-10.0, -9.0, -8.0, -7.0, -6.0], [7.0, 7.0, 7.5, 8.0, 7.0], True),
        ([-10.0, -9.0, -8.0, -7.0, -6.0], [7.0, 7.1, 7.5, 8.0, 9.0], True),  # it was never as little again
        ([-10.0, -9.0, -8.0, -7.0, -6.0], [7.0, 7.0, 6.9, 8.0, 9.0], False),  # once it was less
        ([-10.0, -9.0, -8.0, -7.0, -9.6], [7.0, 7.5, 7.5, 8.0, 9.0], False),  # a rise of 4 %
        ([-6.0, -7.0, -8.0, -9.0, -10.0], [7.0, 7.5, 7.5, 8.0, 9.0], False),  # both are bad: no contradiction
        ([-9.0, -8.0, -7.0, -6.0], [7.0, 8.0, 9.0, 10.0], False),  # too few to tell
        ([99.0, -10.0, -9.0, -8.0, -7.0, -6.0], [1.0, 7.0, 7.0, 7.5, 8.0, 7.0], True),  # the last five count
    ],
)
def test_misleading_return__is_a_return_that_rises_while_harm_does_not_fall(
    returns: list[float], harms: list[float], alarm: bool
) -> None:
    told = misleading_return(_evaluations(returns, harms), "first_impact_harm")
    assert (told is not None) == alarm
    if told is not None:
        assert "since step" in told and "first_impact_harm did not fall (7," in told


def test_misleading_return__entries_without_a_return_or_harm_do_not_count() -> None:
    entries = _evaluations([-10.0, -9.0, -8.0, -7.0, -6.0], [7.0] * 5)
    del entries[0]["episode_return"]
    assert misleading_return(entries, "first_impact_harm") is None
    assert misleading_return(_evaluations([-10.0, -9.0, -8.0, -7.0, -6.0], [7.0] * 5), "total_harm") is None


def test_course__the_best_is_judged_by_the_count_of_the_reward(policy) -> None:
    other = policy.__class__(policy.manifest.model_copy(update={"steps": 5}), policy.tensors)
    course = Course("total")
    assert course.add_evaluation(policy, {"first_impact_harm": 9.0, "total_harm": 10.0}, None) is None
    course.add_evaluation(other, {"first_impact_harm": 1.0, "total_harm": 11.0}, -3.0)
    assert course.kept is policy and course.best_harm == 10.0
    assert course.evaluations[1] == {
        "steps": 0, "updates": 0, "first_impact_harm": 1.0, "total_harm": 11.0, "episode_return": -3.0,
    }  # fmt: skip


def test_course__comes_back_from_its_json(policy) -> None:
    course = Course()
    course.add_evaluation(policy, {"first_impact_harm": 9.0}, None)
    again = Course()
    again.restore(course.to_json())
    assert (again.evaluations, again.best_harm, again.alarms) == (course.evaluations, 9.0, [])
    assert again.wall_s >= course.wall_before_s
