"""Choose MAVLink system IDs for the vehicles of a run."""

from __future__ import annotations

from collections.abc import Sequence

from sitl.vehicle import MAX_SYSID


def system_ids(vehicle_ids: Sequence[int]) -> dict[int, int]:
    """Return a MAVLink system ID, 1 to 255, for each vehicle.

    If the ID of the vehicle is at most 255, it is also the system ID. Other vehicles receive free system IDs. With more
    than 255 vehicles, some vehicles have the same system ID. This has no effect, because each vehicle is alone in its
    network namespace.
    """
    taken = {vehicle_id for vehicle_id in vehicle_ids if vehicle_id <= MAX_SYSID}
    free = [sysid for sysid in range(1, MAX_SYSID + 1) if sysid not in taken] or [MAX_SYSID]
    borrowers = (vehicle_id for vehicle_id in vehicle_ids if vehicle_id > MAX_SYSID)
    lent = {vehicle_id: free[number % len(free)] for number, vehicle_id in enumerate(borrowers)}
    return {vehicle_id: lent.get(vehicle_id, vehicle_id) for vehicle_id in vehicle_ids}
