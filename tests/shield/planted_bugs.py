"""Twenty-two bugs that a shield could have: each, planted in a copy of the repository, must turn some test red.

``make shield-bugs`` (or ``python -m tests.shield.planted_bugs [--only WORD]``). A bug is a textual patch of the shield,
applied to a temporary copy. There ``test_certify``, ``test_step_shield`` and one test of ``test_robust`` run with
compilation switched off, and where they stay green, the other tests of the shield, compiled. Those must be green
without any bug.
"""

from __future__ import annotations

import argparse
import sys

from tests.programme.planting import Patch, misfits, red_with

BY_HAND = "test_by_hand__what_the_nominal_shield_certifies_breaks_its_bound_in_a_corner"
FORMS_TEST = "tests/shield/test_interior.py::test_forms__enclose_what_they_stand_for"
QUICK = (
    "tests/shield/test_certify.py",
    "tests/shield/test_step_shield.py",
    f"tests/shield/test_robust.py::{BY_HAND}",
    FORMS_TEST,
)
WHOLE = tuple(
    f"tests/shield/test_{name}.py"
    for name in ("engine_shield", "step", "rollouts", "interfaces", "interference", "interior")
)
KERNEL, CERTIFY, GUARD, ROLLOUTS, ATTACHED, COMPARISON, FORMS, INSIDE = (
    f"ethbrake_marl/shield/{name}.py"
    for name in (
        "certify_kernel",
        "certify",
        "step_shield",
        "rollouts",
        "engine_shield",
        "comparison",
        "forms",
        "interior",
    )
)

BUGS: dict[str, tuple[Patch, ...]] = {
    "pairwise bound used as if it were coupled": (
        Patch(
            GUARD,
            "harm, alone = plan_harm(running, plan), np.full(worlds.n, np.inf)",
            "harm, alone = plan_harm(running, plan) / 2.0, np.full(worlds.n, np.inf)",
        ),
    ),
    "the budget may rise": (
        Patch(
            KERNEL, "    if value <= budget:\n        plan[step]", "    if value <= 2.0 * budget:\n        plan[step]"
        ),
    ),
    "clipped after certifying": (
        Patch(KERNEL, "min(max(proposed, -1.0), 1.0) if usable", "max(proposed, -1e300) if usable"),
        Patch(
            CERTIFY, "applied, bound, margin = out[:, 0].copy(),", "applied, bound, margin = np.clip(out[:, 0], -1, 1),"
        ),
    ),
    "an impact counted again where the pair was hit before": (
        Patch(
            KERNEL, "    save(world.table, after)\n", "    world.table[HIT, 0] = 0.0\n    save(world.table, after)\n"
        ),
        Patch(KERNEL, "import COMMAND, LIMIT\n", "import COMMAND, HIT, LIMIT\n"),
    ),
    "harm so far forgotten": (
        Patch(KERNEL, "    save(world.table, after)\n", "    world.table[-2:] = 0.0\n    save(world.table, after)\n"),
    ),
    "latency ignored": (
        Patch(
            GUARD,
            "problem = profile_problem(\n                possible,",
            "problem = profile_problem(\n                _at_once(possible),",
        ),
        Patch(
            GUARD,
            "def _harm_of(",
            "def _at_once(worlds: Worlds) -> Worlds:\n    v = worlds.vehicles\n"
            "    return replace(worlds, vehicles=replace(v, latency_s=0.0 * v.latency_s))\n\n\ndef _harm_of(",
        ),
    ),
    "the rest of the plan begins one decision late": (
        Patch(
            KERNEL,
            "value = worst_of_plan(world, after, over, step + 1, plan, budget)",
            "value = worst_of_plan(world, after, over, step + 2, plan, budget)",
        ),
    ),
    "the plan of a rejected proposal is kept": (
        Patch(
            KERNEL,
            "        if value <= budget:\n            plan[:] = room[0]",
            "        if value < math.inf:\n            plan[:] = room[0]",
        ),
        Patch(KERNEL, "plan, budget)\n        reason", "plan, math.inf)\n        reason"),
        Patch(KERNEL, "constants, value, budget, room[0]", "constants, value, math.inf, room[0]"),
    ),
    "a constant counts without being certified step by step": (
        Patch(
            KERNEL,
            "certified = worst_of_plan(world, states, ended, step, trial, most)",
            "certified = least",
        ),
    ),
    "a policy's rollout counts without being followed step by step": (
        Patch(ROLLOUTS, "    harm = plan_harm(part, plan)\n", "    harm = 0.0 * plan_harm(part, plan)\n"),
    ),
    "a rollout disturbs the policy's memory": (
        Patch(ROLLOUTS, "return copy.deepcopy(policy), np.arange(n)", "return policy, np.arange(n)"),
    ),
    "a rollout writes another past into the plan": (
        Patch(ROLLOUTS, "from_now(held[batch], -1.0, episodes.steps)", "np.full_like(held[batch], -1.0)"),
        Patch(
            ROLLOUTS,
            "    assert (plan == from_now(decision.backup.plan[rows], plan, found.after.steps - 1)).all()",
            "",
        ),
    ),
    "only the world as told is certified, not its corners": (
        Patch(
            KERNEL,
            "m = (first + j) % ended.shape[0]\n        worst = max(worst, follow_plan",
            "m = 0\n        worst = max(worst, follow_plan",
        ),
    ),
    "what is seen of the harm so far is not compared": (
        Patch(COMPARISON, "first : first + len(GROUPS) * pairs]], axis=1)", "first : first + 2 * pairs]], axis=1)"),
    ),
    "the shield goes on before the engine does": (
        Patch(
            ATTACHED,
            "        applied = certified.decision.applied\n",
            "        shield.commit(certified)\n        applied = certified.decision.applied\n",
        ),
    ),
    "a second step on one certificate is let pass": (
        Patch(ATTACHED, "if sent is None or sent.memory is not memory:", "if sent is None:"),
    ),
    "what a step led to is not compared": (
        Patch(ATTACHED, "wanted & ~as_predicted(running, seen)", "wanted & (seen != seen).all(axis=1)"),
    ),
    "a step that was not made is not noticed": (
        Patch(ATTACHED, "if self.engine.steps_made != self.sent.steps_made + 1:", "if self.engine.steps_made < 0:"),
    ),
    "what is of second order is left out of a product": (Patch(FORMS, " + radius(x) * radius(y)", ""),),
    "a square root is taken for its chord": (Patch(FORMS, "error = 0.5 * (0.25 / slope - start)", "error = 0.0"),),
    "a plan without a certificate inside the box is held": (
        Patch(INSIDE, "good = found <= least", "good = found <= np.inf"),
    ),
    "a surprise is not flagged": (Patch(GUARD, "if not surprising.any():", "if surprising.any() or True:"),),
}


def main() -> int:
    """Plant every bug and print which test finds it."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", default="", help="only bugs whose name contains this")
    parser.add_argument("--quick", action="store_true", help="only the tests that need no compilation")
    given = parser.parse_args()
    for wrong in (unfit := misfits(BUGS)):
        print(f"ERROR  {wrong}")
    if unfit:
        return 1
    if red := red_with((), QUICK, compiled=False):
        print(f"ERROR  red without any bug: {red}")
        return 1
    names = [name for name in BUGS if given.only in name]
    found = 0
    for name in names:
        red = red_with(BUGS[name], QUICK, compiled=False)
        if not red and not given.quick:
            red = red_with(BUGS[name], WHOLE, compiled=True)
        found += bool(red)
        print(f"{'found ' if red else 'MISSED'}  {name:55s} {red.removeprefix('tests/')}", flush=True)
    print(f"planted shield bugs: {found}/{len(names)} found: {'PASS' if found == len(names) else 'FAIL'}")
    return 0 if found == len(names) else 1


if __name__ == "__main__":
    sys.exit(main())
