"""Spread the agents and vehicles of one run over the workers of a Dask cluster.

The network of the run stays in one lab, on the computer where the command runs. Losses, delays, partitions, radio,
channel and captures are therefore exactly those of a run on one machine. The workers of the cluster run the agents and
the vehicle programs, so their processors share the load. The mechanism of `harness.play.remote` connects each agent.

The program of a vehicle runs on the worker of its agent. Both are in one network there, so the agent reads the
telemetry of its vehicle without a detour. The pilots and the ground station stay in the lab. Each worker has one more
connection. It carries the MAVLink messages between pilots and vehicles, the commands that start and end vehicle
programs, and the files that these programs write. An agent can return after a lost connection. A vehicle program
cannot, because its pilot in the lab gives it up after 10 s without messages.

A mesh of tunnels between labs on all computers was rejected. The delay and the losses of the real network would be
added to those of the scenario, and the engines of several kernels would have to agree.
"""
