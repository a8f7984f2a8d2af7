"""The Docker backend: the vehicles and agents of a run in containers, on the same network as processes have.

engine      the container engine, and what can go wrong with it
images      what containers are made from: the project's image, the scenario's, or this machine's own files
recipe      what a container is given
container   one container as a program of the lab, and what it says
lab         the lab: containers with no network of their own, and `netem`'s cables put into them
ownership   names and labels: which container is whose
leftovers   what `ucp-harness clean` removes
compose     a compose file, to start the same agents by hand

Docker builds no network: every vehicle has a small container that does nothing but hold a network namespace, in which
only `lo` is. `netem` ends the vehicle's cable in there, before the first program starts; the vehicle and its agent join
that namespace, and so does whoever takes their place. So conditions and partitions come from outside, and containers
need neither a capability nor a tool for them.
"""
