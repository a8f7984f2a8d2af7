"""The mission of a scenario, and the backends that play it with real programs or in virtual time."""
