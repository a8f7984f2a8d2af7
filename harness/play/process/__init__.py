"""Vehicles and agents as real processes in a real, private network."""
