"""Run vehicles and agents as real processes in a private virtual network."""
