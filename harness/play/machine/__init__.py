"""Properties of this machine: the doctor, the calibration of the network, and User Mode Linux."""
