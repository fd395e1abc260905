"""Exact motion of a line of vehicles: brakes that build up, contacts, impacts, and the way from event to event."""
