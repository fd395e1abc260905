"""File formats: read files strictly, write them whole or not at all."""
