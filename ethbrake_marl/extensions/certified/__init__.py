"""Shields for incomplete knowledge: ``robust`` for uncertain quantities, ``estimated`` for unknown vehicles."""

from ethbrake_marl.extensions.certified.uncertainty import (
    Uncertainty as Uncertainty,
    parse_uncertainty as parse_uncertainty,
)
