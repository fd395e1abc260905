"""Forecasts of a vehicle's next impacts, as features of its observation."""
