"""Process the records of real flights: read them, replay them, reconstruct the flight, find faulty commits, and merge
chains.
"""
