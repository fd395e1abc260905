"""The features that a policy observes, as its file describes them, and a check that they have not changed since."""

from __future__ import annotations

import hashlib
import json
from functools import cache
from operator import not_
from pathlib import Path
from typing import Annotated, Self

import numpy as np
from pydantic import ConfigDict, Field

from ethbrake_marl.episode.features import FEATURES, ComputedFeature, Of, side_of
from ethbrake_marl.episode.observe import View, observe_computed
from ethbrake_marl.episode.state import State
from ethbrake_marl.errors import CorruptBundle, InvalidInput
from ethbrake_marl.files.model import FileModel
from ethbrake_marl.worlds.catalogue import load_scenario
from ethbrake_marl.worlds.roles import names_of
from ethbrake_marl.worlds.user_worlds import worlds_from_table

# The worlds in which features are tried. Files of policies depend on them.
TRIAL_LINE = {
    "name": "trial", "vehicles": 3, "roles": dict.fromkeys(names_of(3), "coast"), "gaps_m": 10, "speeds_mps": 20,
    "braking_capacity_mps2": [6, 7, 5], "driving_capacity_mps2": [1, 2, 3], "latency_s": [0, 0.5, 0.25],
    "mass_t": [4.5, 15.5, 5.9], "speed_limit_mps": 40, "restitution": 0,
}  # fmt: skip
TRIAL_WORLDS = {
    "gap_1_m": [8, 3, 0.5], "gap_2_m": [6, 21, 40], "restitution": [0, 0.1, 0.3],
    "speed_1_mps": [20, 9, 31], "speed_2_mps": [18, 13, 30], "speed_3_mps": [22, 11, 33],
}  # fmt: skip

Sha256 = Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]
Neighbours = Annotated[int, Field(ge=0, le=64)]


class FiniteModel(FileModel):
    """A part of a file in which infinity and NaN are not allowed."""

    model_config = ConfigDict(allow_inf_nan=False)


class FeatureDefinition(FiniteModel):
    """A feature that is computed by a registered function, as it was in training."""

    name: Annotated[str, Field(max_length=64)]
    of: Of
    unit: str
    scale: float
    low: float
    high: float
    unknown: float
    tried: Annotated[tuple[float, ...], Field(max_length=64)]  # what is observed in a few worlds

    @classmethod
    def of_entry(cls, name: str, entry: ComputedFeature) -> Self:
        feature = entry.feature
        return cls(
            name=name, of=entry.of, unit=feature.unit, scale=feature.scale, low=feature.low, high=feature.high,
            unknown=entry.unknown, tried=_trial_values(entry),
        )  # fmt: skip


class ObservationSchema(FiniteModel):
    """The features that a policy observes, in order, with a hash of their scaling."""

    front: Neighbours  # number of observed neighbours ahead
    rear: Neighbours  # and behind
    features: Annotated[tuple[str, ...], Field(min_length=1, max_length=4096)]
    scaling_sha256: Sha256  # of names, units, scales and bounds
    registered: Annotated[tuple[FeatureDefinition, ...], Field(max_length=4096, exclude_if=not_)] = ()

    @classmethod
    def of(cls, view: View) -> Self:
        scaling = [[f.name, f.unit, f.scale, f.low, f.high] for f in view.features]
        split = [name.rpartition(".") for name in view.names]
        sides = [side_of(name.partition(".")[0]) or 0 for name in view.names]
        names = dict.fromkeys(last for side, _, last in split if last in FEATURES and (not side or side_of(side)))
        return cls(
            front=max(0, -min(sides)), rear=max(0, *sides), features=view.names,
            scaling_sha256=hashlib.sha256(json.dumps(scaling).encode()).hexdigest(),
            registered=tuple(FeatureDefinition.of_entry(name, FEATURES[name]) for name in names),
        )  # fmt: skip

    def check(self, where: Path, version: str) -> None:
        """Raise an error unless every feature is the same as in training: ``InvalidInput`` for a user's feature,
        ``CorruptBundle`` for a feature of this package. ``version``: of this package in training.
        """
        for old in self.registered:
            observes = f"{where}: the policy observes the feature {old.name!r:.80}"
            if old.name not in FEATURES:
                raise InvalidInput(
                    f"{observes}, which is not registered; install the package that registers it, or register it"
                    " yourself first with eb.register_feature"
                )
            entry = FEATURES[old.name]
            new = FeatureDefinition.of_entry(old.name, entry)
            alike = len(old.tried) == len(new.tried) and np.allclose(old.tried, new.tried, rtol=1e-6, atol=1e-6)
            if alike or _is_built_in(entry):
                new = new.model_copy(update={"tried": old.tried})
            for key, value in new:
                if getattr(old, key) != value:
                    what = "value in a few worlds" if key == "tried" else key
                    raise InvalidInput(
                        f"{observes}, whose {what} was {getattr(old, key)!r:.60} in training and is {value!r:.60} now;"
                        " register the feature as in training, or train again"
                    )
        try:
            today = ObservationSchema.of(View(self.features))
        except InvalidInput as error:
            raise CorruptBundle(f"{where}: observation: {error}") from None
        if self.model_copy(update={"registered": today.registered}) != today:
            raise CorruptBundle(
                f"{where}: observation: this version of the package computes or scales features differently than the"
                f" version in which the policy was trained ({version}); use that version, or train again"
            )


def _is_built_in(entry: ComputedFeature) -> bool:
    return str(getattr(entry.function, "__module__", "")).startswith("ethbrake_marl.")


def _trial_values(entry: ComputedFeature) -> tuple[float, ...]:
    """Values of a feature in the trial worlds: in one world if this package defines the feature, else in three."""
    state = _trial_worlds()
    if _is_built_in(entry):
        state = state.take(slice(1))
    all_known = np.ones(state.n, np.bool_)
    places = [(1, 0), (2, 0), (3, 0)] if entry.of == "own" else [(2, -1), (2, 1), (3, -2)]
    values = [observe_computed(entry, state, body, offset, all_known) for body, offset in places]
    return tuple(np.concatenate(values).tolist())


@cache
def _trial_worlds() -> State:
    return worlds_from_table(load_scenario(TRIAL_LINE), TRIAL_WORLDS).read_only()
