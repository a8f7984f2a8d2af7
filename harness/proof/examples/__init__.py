"""Examples of a proof: a path through the graph, written as a scenario and played by the simulation."""
