"""The check that a policy's features are still what their names stand for."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ethbrake_marl.errors import CorruptBundle, InvalidInput
from ethbrake_marl.observations import choose_observation
from ethbrake_marl.policies.manifest import FeatureDefinition, Manifest, observation_schema
from ethbrake_marl.scenario.features import FEATURES


def check_observed(path: Path, manifest: Manifest) -> None:
    """Compare what the policy observes with what these features are now.

    Raises ``InvalidInput`` naming a registered feature that is missing or was changed, ``CorruptBundle`` for features
    that this version does not have, or scales otherwise.
    """
    seen = manifest.observation
    for feature in seen.registered:
        _check_registered(path, feature)
    try:
        today = observation_schema(choose_observation(seen.features))
    except InvalidInput:
        raise _other_features(path, manifest) from None
    was, now = (
        (each.front, each.rear, each.features, [part.name for part in each.registered], each.scaling_sha256)
        for each in (seen, today)
    )
    if was != now:
        raise _other_features(path, manifest)


def _check_registered(path: Path, was: FeatureDefinition) -> None:
    if was.name not in FEATURES:
        raise InvalidInput(
            f"{path}: the policy observes {was.name!r:.80}, which is not registered; import the file that registers it"
            " (eb.register_feature) first"
        )
    entry = FEATURES[was.name]
    now = {name: getattr(entry.feature, name) for name in ("unit", "scale", "low", "high")}
    now |= {"of": entry.of, "unknown": entry.unknown}
    for key, value in now.items():
        if getattr(was, key) != value:
            raise InvalidInput(
                f"{path}: the policy observes {was.name!r:.80}, whose {key} was {getattr(was, key)!r:.60} when it was"
                f" trained and is {value!r:.60} now; register it as it was, or train again"
            )
    if len(was.tried) != len(entry.tried) or not np.allclose(was.tried, entry.tried, rtol=1e-6, atol=1e-6):
        raise InvalidInput(
            f"{path}: the policy observes {was.name!r:.80}, whose function gives other numbers than when it was"
            " trained; register it as it was, or train again"
        )


def _other_features(path: Path, manifest: Manifest) -> CorruptBundle:
    return CorruptBundle(
        f"{path}: observation: features or their scaling are not those of this version of the package;"
        f" use the one it was made with ({manifest.versions.get('ethbrake-marl', 'unknown')}), or train again"
    )
