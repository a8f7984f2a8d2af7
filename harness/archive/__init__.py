"""The run directory and its files: written while a run is active, and read afterwards by checker, report and
commands.
"""
