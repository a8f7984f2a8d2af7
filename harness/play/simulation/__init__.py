"""The very same agents on a simulated air, in virtual time."""
