"""Polars, the package that makes tables for notebooks. It is optional: extra `data`.

Polars and not pandas: it writes Parquet by itself, so one package does what pandas does with pyarrow and NumPy; its
columns have one declared type also where values are missing; and its import takes a third of the time.
"""

from harness.errors import MachineError

try:
    import polars as pl
except ImportError:
    raise MachineError("tables need further packages: `pip install 'ucp-harness[data]'`") from None

__all__ = ["pl"]
