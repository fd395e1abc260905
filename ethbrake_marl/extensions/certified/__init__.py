"""Shields for what is not known: mode ``robust`` against an uncertainty, and ``believed``, on what was received."""

from ethbrake_marl.extensions.certified.uncertainty import (
    UNCERTAINTY_EXAMPLE as UNCERTAINTY_EXAMPLE,
    Uncertainty as Uncertainty,
    parse_uncertainty as parse_uncertainty,
)
