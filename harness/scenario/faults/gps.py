"""A vehicle's GPS is jammed, and heard again."""

from harness.scenario.faults.vehicle_fault import FALLING, RISING, TROUBLED, WELL_AGAIN, VehicleFault
from sitl.circumstances import GPS_LOST, GPS_REGAINED, Circumstance


class LoseGps(VehicleFault):
    """Their vehicles have no GPS from now on."""

    what = "lose_gps"
    mark = FALLING
    meaning = TROUBLED

    @property
    def circumstance(self) -> Circumstance:
        return GPS_LOST


class RegainGps(VehicleFault):
    """Their vehicles have a GPS again."""

    what = "regain_gps"
    mark = RISING
    meaning = WELL_AGAIN

    @property
    def circumstance(self) -> Circumstance:
        return GPS_REGAINED
