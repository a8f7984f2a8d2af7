"""Play many runs of a scenario: in a matrix of conditions, or with many seeds to search for violations."""
