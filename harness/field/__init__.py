"""Process the records of real flights: read them, replay them, reconstruct flights, find faulty commits, and merge
chains.
"""
