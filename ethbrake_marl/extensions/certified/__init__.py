"""Shields for incomplete knowledge: ``robust`` against an uncertainty, and ``estimated`` on received messages only."""

from ethbrake_marl.extensions.certified.uncertainty import (
    Uncertainty as Uncertainty,
    parse_uncertainty as parse_uncertainty,
)
