"""A flight flown again in virtual time, from whatever came home of it.

told        what the agents were told before the flight
elsewhere   what is not in an agent's own trace, and is on record elsewhere
inferring   what reached an agent that left no trace, by its capture
readings    which settings agents had that left no trace
inputs      a trace, taken apart into what reached the agent
rehearsal   one agent alone: how far its record is what the protocol does
alone       that by its trace or its capture, and what explains one that is wrong
clocks      what the agents' clocks show beside each other, from messages alone
timetable   when everything happens, on one time for all
script      that as a scenario
comparing   what virtual time did, beside what is on record
file        the scenario as a file
"""

from harness.field.reconstruct.reconstruct import Reconstruction, reconstruct, write

__all__ = ["Reconstruction", "reconstruct", "write"]
