"""The model of a proof: the states of one agent and of the swarm, and the steps that real agents take between them."""
