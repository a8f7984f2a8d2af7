"""The graph of a proof: all global states within the bounds, explored breadth first on all cores."""
