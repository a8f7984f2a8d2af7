"""A vehicle's compasses fail, and work again."""

from harness.scenario.faults.vehicle_fault import FALLING, RISING, TROUBLED, WELL_AGAIN, VehicleFault
from sitl.circumstances import COMPASS_LOST, COMPASS_REGAINED, Circumstance


class LoseCompass(VehicleFault):
    """None of their vehicles' compasses works from now on."""

    what = "lose_compass"
    mark = FALLING
    meaning = TROUBLED

    @property
    def circumstance(self) -> Circumstance:
        return COMPASS_LOST


class RegainCompass(VehicleFault):
    """Their vehicles' compasses work again."""

    what = "regain_compass"
    mark = RISING
    meaning = WELL_AGAIN

    @property
    def circumstance(self) -> Circumstance:
        return COMPASS_REGAINED
