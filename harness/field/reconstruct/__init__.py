"""Reconstruct a flight: write a scenario that reproduces the flight in virtual time.

The mission, settings and clock offsets come from the records (`_known_mission`, `replay._peer_messages`). The inputs of
an agent come from its trace (`_agent_inputs`), from other agents' records (`OtherRecords`), or are inferred from its
capture (`_inferring`). `_rehearsal` simulates each agent alone, to find the part of its record that follows the
protocol. `_timetable` puts all inputs on one time axis, and `_timetable_script` writes them as a scenario. `_comparing`
compares the simulated flight with the record.
"""

from harness.field.reconstruct.reconstruct import Reconstruction, reconstruct, write

__all__ = ["Reconstruction", "reconstruct", "write"]
