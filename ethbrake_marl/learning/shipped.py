"""Policies that come with the package, and how they are chosen by name.

Each is a folder of ``_policies/``: a bundle, and beside it ``card.md``, which says what it was trained on, how good it
is and where it is bad.
"""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from ethbrake_marl.errors import InvalidInput, unknown_name
from ethbrake_marl.harm import HarmCount
from ethbrake_marl.learning.bundle import Policy, load_policy
from ethbrake_marl.scenario import Scenario

SHIPPED = "shipped"
BUNDLE, CARD = "policy", "card.md"

PolicyKind = Literal["ppo", "sac", "universal"]

_FOLDER = Path(__file__).resolve().parents[1] / "_policies"


def shipped_policies() -> dict[str, Path]:
    """Name -> folder of every policy that ships."""
    return {path.parent.name: path.parent for path in sorted(_FOLDER.glob(f"*/{BUNDLE}"))}


def shipped_name(kind: PolicyKind, scenario: str | None, count: HarmCount) -> str:
    """Name of the policy of this kind for ``scenario``, of those trained for ``count`` if there is one.

    Names are ``universal``, ``ppo-SCENARIO`` and ``sac-SCENARIO``, with ``-total`` behind where a policy was trained
    for total harm. Without a scenario the only one of its kind is meant. Raises ``InvalidInput`` listing what ships.
    """
    names = shipped_policies()
    if kind == "universal" or scenario is not None:
        plain = kind if kind == "universal" else f"{kind}-{scenario}"
        for name in (f"{plain}-total", plain) if count == "total" else (plain,):
            if name in names:
                return name
    else:
        suited = [
            name for name in names if name.startswith(f"{kind}-") and name.endswith("-total") == (count == "total")
        ]
        if len(suited) == 1:
            return suited[0]
    wanted = kind if scenario is None or kind == "universal" else f"{kind} for scenario {scenario!r}"
    every = ", ".join(names) or "none"
    raise InvalidInput(f"shipped policy {wanted}: there is not exactly one; shipped are: {every} (as {SHIPPED}/NAME)")


def load_shipped(name: str) -> Policy:
    """The shipped policy called ``name``; raises ``UnknownName`` with a suggestion."""
    folders = shipped_policies()
    if name not in folders:
        raise unknown_name("shipped policy", name, folders)
    return load_policy(folders[name] / BUNDLE)


def load_named_policy(
    path: str, kind: PolicyKind = "ppo", scenario: Scenario | None = None, count: HarmCount = "first"
) -> Policy:
    """The policy of a run or bundle at ``path``; ``shipped``: the one of this kind for ``scenario``; ``shipped/NAME``.

    A folder that is called so is ``./shipped``. Raises what ``load_policy`` and the functions above raise.
    """
    head, slash, name = path.partition("/")
    if head != SHIPPED:
        return load_policy(path)
    if slash:
        return load_shipped(name)
    return load_shipped(shipped_name(kind, None if scenario is None else scenario.name, count))


def card(name: str) -> str:
    """The card of a shipped policy, in Markdown."""
    folders = shipped_policies()
    if name not in folders:
        raise unknown_name("shipped policy", name, folders)
    return (folders[name] / CARD).read_text("utf-8")
