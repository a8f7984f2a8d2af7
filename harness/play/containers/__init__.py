"""The Docker backend, which runs vehicles and agents in containers, on the same network as the process backend.

Docker does not build the network. For each vehicle, a small container holds a network namespace with nothing but `lo`.
`netem` moves the end of the vehicle's cable into this namespace before the first program starts. The vehicle, its agent
and their replacements join the namespace. Conditions and partitions therefore apply from outside, and containers need
no capabilities and no network tools.
"""
