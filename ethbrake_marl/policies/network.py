"""The networks of a policy: their sizes, and the names and shapes of their tensors."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from ethbrake_marl.files.model import FileModel

Activation = Literal["relu", "tanh"]
Width = Annotated[int, Field(ge=1, le=4096)]
PerhapsHidden = Annotated[tuple[Width, ...], Field(max_length=8)]
Shapes = dict[str, tuple[int, ...]]


class NetworkSpec(FileModel):
    """An actor and optionally a critic: multilayer perceptrons with the same input.

    ``output`` says how the actor's outputs give an action in [-1, 1]:

    - ``clip``: the output, clipped. In training (PPO) it is the mean of a Gaussian with one noise parameter per action.
    - ``tanh``: the tanh of the output. In training (SAC) a second head of the actor gives the noise.
    """

    observation_size: Annotated[int, Field(ge=1, le=4096)]  # F
    action_size: Literal[1] = 1
    policy_hidden: Annotated[PerhapsHidden, Field(min_length=1)]  # width of each hidden layer of the actor
    value_hidden: PerhapsHidden  # of the critic; empty: no critic, which no policy needs to act
    activation: Activation
    output: Literal["clip", "tanh"]

    @property
    def tensors(self) -> Shapes:
        """Shapes of all float32 tensors, name -> shape; a weight is [outputs, inputs], as in ``y = W x + b``."""
        shapes = self._network("policy", self.policy_hidden)
        if self.output == "clip":
            shapes["policy.log_std"] = (1,)
        else:
            shapes |= _layer("policy.log_std", self.policy_hidden[-1], 1)
        if self.value_hidden:
            shapes |= self._network("value", self.value_hidden)
        return shapes

    def _network(self, name: str, hidden: tuple[int, ...]) -> Shapes:
        sizes = (self.observation_size, *hidden)
        shapes: Shapes = {}
        for k, width in enumerate(hidden):
            shapes |= _layer(f"{name}.{k}", sizes[k], width)
        return shapes | _layer(f"{name}.output", sizes[-1], 1)


def _layer(name: str, inputs: int, outputs: int) -> Shapes:
    return {f"{name}.weight": (outputs, inputs), f"{name}.bias": (outputs,)}
