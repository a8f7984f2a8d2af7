"""What this machine can do: the doctor, the calibration of its network, and another kernel where it needs one."""
