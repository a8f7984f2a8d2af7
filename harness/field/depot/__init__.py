"""Before and after a mission: the mission files of all vehicles, and their exports merged into one record."""
