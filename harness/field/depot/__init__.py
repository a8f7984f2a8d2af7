"""Prepare a mission and process its results: write the mission files of all vehicles, and merge their exports into one
record.
"""
