"""Write the mission files of all vehicles before a mission, and merge the chain exports of the vehicles into one record
after it.
"""
