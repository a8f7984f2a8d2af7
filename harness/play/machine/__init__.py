"""Examine this machine: its requirements, the accuracy of its network, and its support for User Mode Linux."""
