"""The first edition: what extensions still use of it. Nothing new imports it; it is deleted at the end."""
