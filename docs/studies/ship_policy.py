"""The bundle of a policy without its critic, which it does not need to act: how a policy ships.

.venv/bin/python docs/studies/ship_policy.py RUN ethbrake_marl/_policies/NAME/policy
"""

from __future__ import annotations

import sys
from pathlib import Path

from ethbrake_marl.policies import Manifest, Policy, load_policy


def actor_only(policy: Policy) -> Policy:
    """The same actions from half the bytes."""
    network = policy.manifest.network.model_copy(update={"value_hidden": ()})
    fields = {name: getattr(policy.manifest, name) for name in Manifest.model_fields}
    del fields["weights_sha256"], fields["manifest_sha256"]
    tensors = {row.name: policy.tensors[row.name] for row in network.tensors}
    return Policy.make(tensors, **{**fields, "network": network})


if __name__ == "__main__":
    actor_only(load_policy(sys.argv[1])).save(Path(sys.argv[2]))
