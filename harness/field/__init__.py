"""Process the records of real flights. The package imports records, replays them, reconstructs flights, finds the
commit that caused an error, and merges chains.
"""
