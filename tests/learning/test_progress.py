from __future__ import annotations

import pytest

from ethbrake_marl.learning.runs import Course, lost_training, misleading_return


def _evaluations(returns: list[float], harms: list[float]) -> list[dict[str, float]]:
    pairs = zip(returns, harms, strict=True)
    return [
        {"steps": 100.0 * k, "episode_return": gained, "first_impact_harm": harm}
        for k, (gained, harm) in enumerate(pairs)
    ]


@pytest.mark.parametrize(
    ("returns", "harms", "alarm"),
    [
        ([-10.0, -9.0, -9.5, -8.0, -7.0, -6.0], [7.0, 7.2, 7.1, 7.5, 8.0, 7.6], True),
        ([0.50, 0.51, 0.49, 0.52, 0.53, 0.54], [7.0, 7.2, 7.1, 7.5, 8.0, 7.6], True),  # near 0 a rise is small
        ([-10.0, -9.0, -9.5, -8.0, -7.0, -6.0], [7.0, 7.2, 7.1, 7.5, 7.2, 8.0], False),  # once no more than before
        ([-10.0, -9.0, -9.5, -8.0, -9.0, -6.0], [7.0, 7.2, 7.1, 7.5, 8.0, 7.6], False),  # a return as before
        ([-6.0, -7.0, -8.0, -9.0, -10.0, -11.0], [7.0, 7.2, 7.1, 7.5, 8.0, 9.0], False),  # both bad: no contradiction
        ([-10.0, -9.0, -9.5, -8.0, -7.0, -6.0], [7.0, 7.0, 7.1, 7.2, 7.2, 7.2], False),  # noise shrinks at the optimum
        ([-9.0, -9.0, -8.0, -7.0, -6.0], [7.0, 7.0, 8.0, 9.0, 10.0], False),  # too few to tell
        ([99.0, -10.0, -9.0, -9.5, -8.0, -7.0, -6.0], [99.0, 7.0, 7.2, 7.1, 7.5, 8.0, 7.6], True),  # the last six count
    ],
)
def test_misleading_return__is_a_return_that_rises_together_with_harm(
    returns: list[float], harms: list[float], alarm: bool
) -> None:
    told = misleading_return(_evaluations(returns, harms), "first_impact_harm")
    assert (told is not None) == alarm
    if told is not None:
        assert "first_impact_harm from 7.1 to 7.7 (" in told
        assert f"since step {100 * (len(harms) - 4):,} the return rose" in told


def _harms(harms: list[float], at_horizon: list[float] | None = None) -> list[dict[str, float]]:
    shares = [None] * len(harms) if at_horizon is None else at_horizon
    return [
        {"steps": 1000.0 * k, "total_harm": harm, **({} if share is None else {"horizon_rate": share})}
        for k, (harm, share) in enumerate(zip(harms, shares, strict=True))
    ]


@pytest.mark.parametrize(
    ("harms", "at_horizon", "lost"),
    [
        ([90.0, 9.0, 7.0, 29.0, 30.0], None, True),
        ([90.0, 9.0, 7.0, 29.0, 16.0], None, True),  # still more than a tenth of the way back
        ([90.0, 9.0, 7.0, 29.0], None, False),  # one evaluation may be an accident
        ([90.0, 9.0, 7.0, 29.0, 15.0], None, False),  # on its way back: less than a tenth of what was gained
        ([90.0, 9.0, 7.0, 29.0, 9.0, 29.0], None, False),
        ([90.0, 30.0, 22.0, 29.0, 30.0], None, False),  # not half as much again as the least
        ([20.0, 0.02, 0.01, 0.04, 0.05], None, False),  # a multiple of next to nothing
        ([6.9, 6.7, 6.8, 6.9, 6.9], None, False),  # began with a policy that was good already
        ([6.9, 6.7, 6.8, 29.0, 184.7], None, True),
        ([90.0, 140.0, 150.0], None, True),  # never learned, and worse than to begin with
        ([90.0, 7.0, 8.0, 8.1], [1.0, 0.1, 0.7, 1.0], True),  # more harm, and the episodes do not end any more
        ([90.0, 7.0, 8.0, 8.1], [1.0, 0.1, 0.3, 0.4], False),
        ([90.0, 7.0, 7.0, 7.1], [1.0, 0.1, 0.7, 1.0], False),  # they do not end, but nobody is hurt by it
        ([90.0, 9.0, 8.0, 7.0], [1.0, 0.1, 0.7, 1.0], False),
    ],
)
def test_lost_training__is_harm_that_came_back_and_stays(
    harms: list[float], at_horizon: list[float] | None, lost: bool
) -> None:
    told = lost_training(_harms(harms, at_horizon), "total_harm")
    assert (told is not None) == lost
    if told is not None:
        assert "training is lost" in told and f"step {1000 * (len(harms) - 1):,}:" in told
        assert ("horizon" in told) == (at_horizon is not None)


# As measured every 163,840 decisions (2026-11-21): recipe ppo with contact features and ``horizon_is_end: false``, and
# recipe ppo for twice its decisions, whose episodes the horizon cuts off more and more often at the same harm.
COLLAPSED = [91.91, 10.28, 11.56, 12.02, 14.74, 18.90, 25.70, 37.11, 47.96, 70.85]
STAYED = [
    91.54, 11.13, 8.73, 7.71, 8.81, 8.77, 8.78, 7.19, 6.97, 6.86, 7.63, 7.01, 7.09, 7.01,
    7.26, 7.09, 7.43, 6.81, 7.17, 7.12,
]  # fmt: skip
CUT_OFF = [0.19, 0.29, *[0.65] * 18]


def test_lost_training__in_two_real_trainings() -> None:
    lost = [lost_training(_harms(COLLAPSED[:k], [1.0] * k), "total_harm") for k in range(len(COLLAPSED) + 1)]
    assert [k for k, alarm in enumerate(lost) if alarm is not None] == [7, 8, 9, 10]
    assert not any(lost_training(_harms(STAYED[:k], CUT_OFF[:k]), "total_harm") for k in range(len(STAYED) + 1))


def test_lost_training__needs_a_measured_harm() -> None:
    assert lost_training(_harms([90.0, 7.0, 60.0, 60.0]), "first_impact_harm") is None
    assert lost_training([], "total_harm") is None


def test_course__says_that_it_is_lost_until_it_is_found_again(policy) -> None:
    course, told = Course("total"), []
    for harm in (90.0, 7.0, 60.0, 60.0, 60.0, 7.5):
        told.append(course.add_evaluation(policy, {"total_harm": harm}, None))
        assert (course.lost is None) == (told[-1] is None)
    assert [each is not None for each in told] == [False, False, False, True, True, False]
    assert course.alarms == told[3:5]


def test_misleading_return__entries_without_a_return_or_harm_do_not_count() -> None:
    returns, harms = [-10.0, -9.0, -9.5, -8.0, -7.0, -6.0], [7.0, 7.2, 7.1, 7.5, 8.0, 7.6]
    entries = _evaluations(returns, harms)
    del entries[0]["episode_return"]
    assert misleading_return(entries, "first_impact_harm") is None
    assert misleading_return(_evaluations(returns, harms), "total_harm") is None


def test_course__the_best_is_judged_by_the_count_of_the_reward(policy) -> None:
    other = policy.__class__(policy.manifest.model_copy(update={"steps": 5}), policy.tensors)
    course = Course("total")
    assert course.add_evaluation(policy, {"first_impact_harm": 9.0, "total_harm": 10.0}, None) is None
    course.add_evaluation(other, {"first_impact_harm": 1.0, "total_harm": 11.0}, -3.0)
    assert course.kept is policy and course.best_harm == 10.0
    assert course.evaluations[1] == {
        "steps": 0, "updates": 0, "first_impact_harm": 1.0, "total_harm": 11.0, "episode_return": -3.0,
    }  # fmt: skip


def test_course__the_best_and_the_alarms_go_by_the_objective_where_one_is_told(policy) -> None:
    by_steps = [policy.__class__(policy.manifest.model_copy(update={"steps": k}), policy.tensors) for k in range(4)]
    course, alarms = Course(), []
    for each, line, objective in zip(by_steps, (24.0, 30.0, 20.0, 18.0), (8.0, 0.1, 6.0, 7.0), strict=True):
        metrics = {"first_impact_harm": line, "objective": objective, "objective_vehicle_2": objective}
        alarms.append(course.add_evaluation(each, metrics, None))
    assert course.kept is by_steps[1] and course.best_harm == 0.1
    assert alarms[:3] == [None] * 3 and "objective is 7, and was 0.1" in alarms[3]
    adversary = Course()  # an amount below 0 that falls is no harm that has risen
    for k, each in enumerate([*by_steps, *by_steps]):
        assert adversary.add_evaluation(each, {"first_impact_harm": 20.0 + k, "objective": -20.0 - k}, float(k)) is None
    assert adversary.best_harm == -27.0


def test_course__that_was_begun_without_an_objective_goes_on_by_harm(policy) -> None:
    course = Course()
    course.add_evaluation(policy, {"first_impact_harm": 9.0}, None)
    course.add_evaluation(policy, {"first_impact_harm": 9.5, "objective": 1.0}, None)
    assert course.best_harm == 9.0


def test_course__comes_back_from_its_json(policy) -> None:
    course = Course()
    course.add_evaluation(policy, {"first_impact_harm": 9.0}, None)
    again = Course()
    again.restore(course.to_json())
    assert (again.evaluations, again.best_harm, again.alarms) == (course.evaluations, 9.0, [])
    assert again.wall_s >= course.wall_before_s
