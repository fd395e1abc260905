"""Policies that ship with the package, and how they are chosen by name.

Each is a folder in ``_policies/`` with a bundle and ``card.md``, which says what the policy was trained on, how good it
is and where it fails.
"""

from __future__ import annotations

from pathlib import Path

from ethbrake_marl.errors import InvalidInput, unknown_name
from ethbrake_marl.game.harm import HarmCount
from ethbrake_marl.policies.bundle import load_policy
from ethbrake_marl.policies.policy import Policy
from ethbrake_marl.scenario.schema import Scenario

SHIPPED = "shipped"

_FOLDER = Path(__file__).resolve().parents[1] / "_policies"


def shipped_policies() -> dict[str, Path]:
    """Return name -> folder of the bundle of every shipped policy."""
    return {path.parent.name: path.parent for path in sorted(_FOLDER.glob("*/policy"))}


def shipped_name(kind: str, scenario: Scenario | None, harm_count: HarmCount) -> str:
    """Return the name of the shipped policy that fits ``kind`` and ``scenario`` best.

    ``ppo-SCENARIO`` and ``sac-SCENARIO`` are for one scenario; the suffix ``-total`` means trained for total harm.
    Raises ``InvalidInput`` with a list of the shipped policies if none fits.

    Args:
        kind: ``universal``: the policy for all scenarios; ``ppo`` or ``sac``: one trained on this scenario; ``policy``:
            the policy whose name ends in the scenario's, otherwise ``universal``.
        scenario: scenario in which the policy will be used; None: any.
        harm_count: preferred harm of the training: ``"first"`` impact of each pair, or ``"total"``.

    """
    names, here = shipped_policies(), None if scenario is None else scenario.name
    if kind == "policy":
        ends = (f"{here}-total", here) if harm_count == "total" else (here,)
        return next((name for end in ends for name in names if name.partition("-")[2] == end), "universal")
    for stem in [kind] if here is None or kind == "universal" else [f"{kind}-{here}", kind]:
        for name in (f"{stem}-total", stem) if harm_count == "total" else (stem,):
            if name in names and (
                stem != kind
                or kind == "universal"
                or scenario is None
                or load_shipped(name).manifest.scenario.get("name") == here
            ):
                return name
    wanted = kind if scenario is None or kind == "universal" else f"{kind} for scenario {here!r}"
    every = ", ".join(names) or "none"
    raise InvalidInput(
        f"shipped policy {wanted}: there is none; shipped are: {every}; each is driven as {kind}@{SHIPPED}/NAME,"
        " and universal@shipped in every scenario"
    )


def load_shipped(name: str) -> Policy:
    """Load the shipped policy called ``name``, such as ``universal``; raise ``UnknownName`` with a suggestion."""
    folders = shipped_policies()
    if name not in folders:
        raise unknown_name("shipped policy", name, folders)
    return load_policy(folders[name])


def load_named_policy(
    path: str, kind: str = "ppo", scenario: Scenario | None = None, harm_count: HarmCount = "first"
) -> Policy:
    """Load a policy: from a folder, or a shipped one.

    Args:
        path: a run or a bundle, ``shipped/NAME``, or ``shipped``: the one that ``shipped_name`` selects. A folder of
            that name is written ``./shipped``.
        kind: see ``shipped_name``; used only for ``shipped``.
        scenario: see ``shipped_name``.
        harm_count: see ``shipped_name``.

    Raises what ``load_policy``, ``load_shipped`` and ``shipped_name`` raise.

    """
    head, slash, name = path.partition("/")
    if head != SHIPPED:
        return load_policy(path)
    if slash:
        return load_shipped(name)
    return load_shipped(shipped_name(kind, scenario, harm_count))
