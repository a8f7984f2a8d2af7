"""Vehicles: ArduPilot SITL, the embedded vehicle, and the pilot that flies either over MAVLink."""
