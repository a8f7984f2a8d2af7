"""Before and after a mission."""
