"""What nobody can avoid: proven bounds on harm, whatever the controlled vehicle does."""
