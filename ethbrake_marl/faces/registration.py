"""Register the environments with Gymnasium and PettingZoo, without importing them."""

from __future__ import annotations

from typing import Any

GYMNASIUM_ID = "EthBrake-v3"
MO_GYMNASIUM_ID = "EthBrakeMO-v1"  # with vector rewards, for MO-Gymnasium
PETTINGZOO_ID = "ethbrake/ethbrake-v3"
ENTRIES: dict[str, Any] = {
    "entry_point": "ethbrake_marl.faces.gymnasium:EthBrakeEnv",
    "vector_entry_point": "ethbrake_marl.faces.vector:EthBrakeVectorEnv",
}


def register_environments() -> None:
    """PettingZoo has a registry from version 1.27 on."""
    import gymnasium  # imported here, because the import takes time
    import pettingzoo

    # Gymnasium's checker would warn about array rewards
    of_vectors: dict[str, Any] = {"disable_env_checker": True, "kwargs": {"reward_vector": "vehicles"}}
    for id_, settings in {GYMNASIUM_ID: dict[str, Any](), MO_GYMNASIUM_ID: of_vectors}.items():
        if id_ not in gymnasium.registry:
            gymnasium.register(id_, **ENTRIES, **settings)
    for interface, name in (("parallel", "parallel_env"), ("aec", "env")):
        if PETTINGZOO_ID not in getattr(pettingzoo, f"{interface}_registry", {PETTINGZOO_ID}):
            pettingzoo.register(interface, PETTINGZOO_ID, f"ethbrake_marl.ethbrake_v3:{name}")
