"""Files and their formats: read strictly, and written completely or not at all."""
