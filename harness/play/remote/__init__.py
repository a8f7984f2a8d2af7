"""Connect a vehicle of a lab to an agent that runs on another computer.

The harness starts a *stand-in* in the network of the vehicle, in place of the agent. The stand-in is a program under
the agent contract. Start, kill, pause, traces, exports, losses, partitions and radio therefore work as for any agent.
The *far end* is `ucp-harness join` on the other computer. It starts the agent in a private network with the same
addresses. One TCP connection joins the stand-in and the far end, and carries all data between them: datagrams,
requests, the trace and the export.

A UDP tunnel for the datagrams would have less delay on a link that loses packets. The connection is better for a test:

- A lost packet becomes a delay, which is measured. It never adds to the losses that a scenario asks for.
- The order is kept. The lines of a trace arrive before the datagrams that they describe, so a record never lacks the
  sender's line of a message that other agents received.
- The far end needs one outgoing connection, which passes through address translation and SSH.

Sockets belong to the network namespace in which they were made. At both ends, a process outside connects and checks
the secret, and then hands the connected socket to the process inside the vehicle's network.
"""
