"""What was avoidable, the least harm that is known, and how far an agent is from it."""
