"""Carry out the mission of a scenario, either with real programs or as a simulation in virtual time."""
