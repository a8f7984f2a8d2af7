"""Run a scenario many times, either in a matrix of network conditions and other values, or with many seeds to search
for violations.
"""
