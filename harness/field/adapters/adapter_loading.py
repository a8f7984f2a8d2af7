"""Finds an adapter: MODULE:CLASS, the module by its name, or a user's file by its path."""

import importlib
import importlib.util
from pathlib import Path

from harness.errors import FieldError
from harness.field.adapters.adapter import Adapter

_HOW = "give MODULE:CLASS, as my_logs:MyAdapter or path/to/my_logs.py:MyAdapter (docs/adapters.md)"


def load_adapter(name: str) -> Adapter:
    """Raises FieldError if there is no such adapter, or it cannot be made."""
    module_name, separator, class_name = name.rpartition(":")
    if not separator or not module_name or not class_name.isidentifier():
        raise FieldError(f"{name!r} names no adapter: {_HOW}")
    try:
        if module_name.endswith(".py"):
            path = Path(module_name)
            spec = importlib.util.spec_from_file_location(path.stem, path)
            assert spec is not None and spec.loader is not None
            module = importlib.util.module_from_spec(spec)
            spec.loader.exec_module(module)
        else:
            module = importlib.import_module(module_name)
        adapter = getattr(module, class_name)()
    except Exception as error:  # it is anybody's code
        raise FieldError(f"the adapter {name} cannot be loaded: {type(error).__name__}: {error}; {_HOW}") from None
    if not isinstance(adapter, Adapter):
        raise FieldError(f"{name} is no subclass of harness.field.adapters.Adapter: see docs/adapters.md")
    return adapter
