"""Write examples of a violation: a path through the state graph becomes a scenario that the simulation plays."""
