"""Independent calls, one at a time in this process; the slow tests of evaluation have several."""

from ethbrake_marl.parallel import run_each


def test_calls__are_taken_shortly_before_their_turn_and_answered_in_order() -> None:
    taken: list[int] = []
    answers = run_each((pow, taken.append(k) or k, 2) for k in (3, 1, 2))
    assert (next(answers), taken) == (9, [3])
    assert ([*answers], taken) == ([1, 4], [3, 1, 2])
