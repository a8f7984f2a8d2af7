"""Use compiled modules in place of their sources, if this installation has them.

A release wheel holds the driver of virtual time, the checker and the prover twice: as sources, and as extension modules
that mypyc compiled from these sources (`docs/generate/compiled_modules.py`). Both give the same results. The agent in
`ucp/` is never compiled, because its handlers can be replaced and debugged.

Compiled modules call each other without Python's look-ups, so a process uses all of them or none. It uses none if the
environment variable `UCP_PURE` is 1, if a source file differs from the compiled one, or if a different Python compiled
the modules. A developer can therefore edit a source at any time, and the edited source runs. The extension modules are
in a separate directory. If an extension module were next to its source, Python would always load the extension module.
"""

import json
import os
import sys
from collections.abc import Mapping, Sequence
from importlib.machinery import ExtensionFileLoader, ModuleSpec
from pathlib import Path
from types import ModuleType

ROOT = Path(__file__).parents[1]
DIRECTORY = Path(__file__).with_name("compiled_modules")
MANIFEST = "manifest.json"
"""File in `DIRECTORY`: the Python that compiled the modules, each module with the digest of its source, and the shared
library of all modules."""
TAG = sys.implementation.cache_tag
COMPILED = "compiled"

in_use = "sources"
"""The modules that this process runs: `COMPILED`, or "sources" with the reason why compiled modules are not used."""


class CompiledModules:
    """An import finder that finds the compiled modules before Python finds their sources. `files` maps the name of each
    module to the file of its extension module.
    """

    def __init__(self, files: Mapping[str, Path]) -> None:
        self._files = files

    def find_spec(self, name: str, path: Sequence[str] | None, target: ModuleType | None = None) -> ModuleSpec | None:
        file = self._files.get(name)
        return None if file is None else ModuleSpec(name, ExtensionFileLoader(name, str(file)), origin=str(file))


def source_of(module: str) -> Path:
    return ROOT.joinpath(*module.split(".")).with_suffix(".py")


def digest_of(source: Path) -> str:
    from hashlib import sha256  # loads OpenSSL, which an installation without compiled modules need not load here

    return sha256(source.read_bytes()).hexdigest()


def use_compiled_modules() -> None:
    """Make later imports load the compiled modules, and set `in_use`. If compiled modules exist but cannot be used,
    `in_use` states the reason.
    """
    global in_use
    try:
        manifest = json.loads((DIRECTORY / MANIFEST).read_bytes())
    except FileNotFoundError:
        return
    reason = _why_not(manifest)
    if reason is not None:
        in_use = f"sources, because {reason}"
        return
    names = [*manifest["sources"], manifest["library"]]
    sys.meta_path.insert(0, CompiledModules({name: DIRECTORY / f"{name}{manifest['suffix']}" for name in names}))
    in_use = COMPILED


def _why_not(manifest: dict[str, str | dict[str, str]]) -> str | None:
    """Return the reason why the compiled modules cannot be used. Return None if they can."""
    if os.environ.get("UCP_PURE", "0") not in ("", "0"):
        return "UCP_PURE is set"
    if manifest["python"] != TAG:
        return f"the compiled modules are for {manifest['python']}, not for {TAG}"
    sources = manifest["sources"]
    assert isinstance(sources, dict), "the build writes it"
    for module, digest in sources.items():
        if module in sys.modules:
            return f"{module} was imported before the harness"
        if digest_of(source_of(module)) != digest:
            return f"{module} has changed since the compilation"
    return None
