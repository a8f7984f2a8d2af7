"""The Docker backend: the vehicles and agents of a run in containers, on the network that processes have.

Docker builds no network. A small container for each vehicle holds a network namespace, in which only `lo` exists.
`netem` puts the end of the vehicle's cable into that namespace before the first program starts. The vehicle, its agent,
and any replacement of them join the namespace. So conditions and partitions apply from outside, and containers need no
capability and no tool for them.
"""
