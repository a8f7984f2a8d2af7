"""Convert a violation to an example: the path to it in the state graph becomes a scenario that the simulation plays."""
