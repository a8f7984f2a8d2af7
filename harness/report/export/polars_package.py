"""Import polars, the package for tables in notebooks. polars is an optional dependency (extra `data`).

Polars was chosen over pandas for three reasons. It writes Parquet itself, whereas pandas needs pyarrow and NumPy. Its
columns have one declared type even with missing values. Its import takes a third of the time.
"""

from harness.errors import extra

with extra("data", "a table"):
    import polars as pl

__all__ = ["pl"]
