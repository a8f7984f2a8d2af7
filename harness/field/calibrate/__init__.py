"""Calibrate the radio model of a scenario with the records and flight logs of a real flight.

`_delivery_model.py` defines the model and fits it. `_attempts.py` and `_positions.py` read the records.
`calibration.py` validates the fit and writes the scenario.
"""
