"""One of a copter's motors fails."""

from harness.scenario.faults.vehicle_fault import FALLING, TROUBLED, VehicleFault
from sitl.circumstances import MOTOR_STOPPED, Circumstance


class StopMotor(VehicleFault):
    """One motor of each of their copters gives no thrust any more: one with four falls."""

    what = "stop_motor"
    of_types = ("copter",)
    mark = FALLING
    meaning = TROUBLED

    @property
    def circumstance(self) -> Circumstance:
        return MOTOR_STOPPED
