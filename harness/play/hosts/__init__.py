"""Spread the agents of one run over the workers of a Dask cluster.

The network of the run stays in one lab, on the computer where the command runs. Losses, delays, partitions, radio,
channel and captures are therefore exactly those of a run on one machine. The workers of the cluster run the agents, so
their processors share the load. Each worker joins the run once for all its agents, with the mechanism of
`harness.play.remote`.

A mesh of tunnels between labs on all computers was rejected. Each link between two computers would have the delay and
the losses of the real network in addition to those of the scenario, and the engines of several kernels would have to
agree.
"""
