"""Policies that come with the package, and how they are chosen by name.

Each is a folder of ``_policies/``: a bundle, and beside it ``card.md``, which says what it was trained on, how good it
is and where it is bad.
"""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
from typing import Literal

from ethbrake_marl.errors import InvalidInput, unknown_name
from ethbrake_marl.harm import HarmCount
from ethbrake_marl.policies.policy import Policy, load_policy
from ethbrake_marl.scenario import Scenario

SHIPPED = "shipped"
BUNDLE = "policy"

PolicyKind = Literal["ppo", "sac", "counterfactual", "universal", "policy"]
_BEST_FIRST: tuple[PolicyKind, ...] = ("counterfactual", "ppo", "sac", "universal")  # of ``policy``, where several are

_FOLDER = Path(__file__).resolve().parents[1] / "_policies"


def shipped_policies() -> dict[str, Path]:
    """Name -> folder of every policy that ships."""
    return {path.parent.name: path.parent for path in sorted(_FOLDER.glob(f"*/{BUNDLE}"))}


def shipped_name(kind: PolicyKind, scenario: str | None, harm_count: HarmCount) -> str:
    """Name of the policy of this kind for ``scenario``, of those trained for ``harm_count`` if there is one.

    ``universal`` is for all scenarios, ``ppo`` and ``sac`` are for the one that they were trained on, ``ppo-SCENARIO``
    and ``sac-SCENARIO`` for that one; ``-total`` behind says that a policy was trained for total harm. ``policy`` is
    the best of all kinds. Raises ``InvalidInput`` listing what ships.
    """
    names = shipped_policies()
    for each in _BEST_FIRST if kind == "policy" else ():
        with suppress(InvalidInput):
            return shipped_name(each, scenario, harm_count)
    plain = [kind] if kind == "universal" or scenario is None else [f"{kind}-{scenario}", kind]
    for stem in plain:
        for name in (f"{stem}-total", stem) if harm_count == "total" else (stem,):
            if name in names and (stem != kind or scenario is None or _is_for(kind, names[name], scenario)):
                return name
    wanted = kind if scenario is None or kind == "universal" else f"{kind} for scenario {scenario!r}"
    every = ", ".join(names) or "none"
    raise InvalidInput(f"shipped policy {wanted}: there is none; shipped are: {every} (each as {SHIPPED}/NAME)")


def _is_for(kind: PolicyKind, folder: Path, scenario: str) -> bool:
    return kind == "universal" or load_policy(folder / BUNDLE).manifest.scenario.get("name") == scenario


def load_shipped(name: str) -> Policy:
    """The shipped policy called ``name``; raises ``UnknownName`` with a suggestion."""
    folders = shipped_policies()
    if name not in folders:
        raise unknown_name("shipped policy", name, folders)
    return load_policy(folders[name] / BUNDLE)


def load_named_policy(
    path: str, kind: PolicyKind = "ppo", scenario: Scenario | None = None, harm_count: HarmCount = "first"
) -> Policy:
    """The policy of a run or bundle at ``path``; ``shipped``: the one of this kind for ``scenario``; ``shipped/NAME``.

    A folder that is called so is ``./shipped``. Raises what ``load_policy`` and the functions above raise.
    """
    head, slash, name = path.partition("/")
    if head != SHIPPED:
        return load_policy(path)
    if slash:
        return load_shipped(name)
    return load_shipped(shipped_name(kind, None if scenario is None else scenario.name, harm_count))
