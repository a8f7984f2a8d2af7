"""Build the state graph of a proof: all states of the swarm within bounds, explored breadth first on all processor
cores.
"""
