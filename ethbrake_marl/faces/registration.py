"""Register the environments with Gymnasium and PettingZoo, without importing them."""

from __future__ import annotations

from typing import Any

from ethbrake_marl.errors import MissingExtra

GYMNASIUM_ID = "EthBrake-v1"
MO_GYMNASIUM_ID = "EthBrakeMO-v1"  # with vector rewards, for MO-Gymnasium
PETTINGZOO_ID = "ethbrake/ethbrake-v1"
ENTRIES: dict[str, Any] = {
    "entry_point": "ethbrake_marl.faces.gymnasium:EthBrakeEnv",
    "vector_entry_point": "ethbrake_marl.faces.vector:EthBrakeVectorEnv",
}


def register_environments() -> None:
    """Register all ids that are not yet registered. Raises ``MissingExtra`` for an old PettingZoo."""
    import gymnasium  # imported here, because the import takes time
    import pettingzoo

    # Gymnasium's checker would warn about array rewards
    of_vectors: dict[str, Any] = {"disable_env_checker": True, "kwargs": {"reward_vector": "vehicles"}}
    for id_, settings in {GYMNASIUM_ID: dict[str, Any](), MO_GYMNASIUM_ID: of_vectors}.items():
        if id_ not in gymnasium.registry:
            gymnasium.register(id_, **ENTRIES, **settings)
    if not hasattr(pettingzoo, "parallel_registry"):
        raise MissingExtra(
            f"needs pettingzoo 1.27 or newer; {getattr(pettingzoo, '__version__', 'an older one')} is installed"
        )
    if PETTINGZOO_ID not in pettingzoo.parallel_registry:
        pettingzoo.register("parallel", PETTINGZOO_ID, "ethbrake_marl.ethbrake_v1:parallel_env")
    if PETTINGZOO_ID not in pettingzoo.aec_registry:
        pettingzoo.register("aec", PETTINGZOO_ID, "ethbrake_marl.ethbrake_v1:env")
