"""Limits of a world, whoever drives: what is avoidable, the least harm known, the harm that is proven."""
