"""Write and read the files of a run directory. Backends write them, and the checker, the report and the commands read
them.
"""
