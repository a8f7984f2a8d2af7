"""Before and after a mission: what every vehicle is given, and what all of them brought back, as one record."""
