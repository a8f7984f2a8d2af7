"""Compile modules of the harness with mypyc: `python -m docs.generate.compiled_modules`.

The result is the directory `harness/compiled_modules/`, which `harness.compiled` uses. `make compiled` calls this
program in a clone. The hook that builds the wheel calls it if the environment variable UCP_COMPILE is 1. The program
needs the packages `mypy[mypyc]` and `setuptools`, and a C compiler. MYPYC_OPT_LEVEL is the level of optimization of the
compiler, 0 to 3.

The list `MODULES` has the modules in which the simulation, the checker and the prover spend their time. Other modules
are interpreted:

- All of `ucp/`. Compiled code would call the original handlers in place of those of a wrong agent or a variant, and a
  debugger could not stop in them.
- Modules with pydantic models, such as `harness.archive.traces`. Their metaclass cannot be compiled.
- `harness.checker.reference.state` and `harness.checker.steps._adopting_core`. The installed core is a subclass of
  them, and a native class cannot share its attributes with it.
- `harness.checker.reference.reference_agent`, because conformance tests read the attributes of the agent by name.
- `harness.proof.model._reference_step`, on which mypyc 2.4 fails.
"""

import json
import os
import shutil
import sys
import sysconfig
from pathlib import Path
from tempfile import TemporaryDirectory

from mypyc.build import mypycify
from setuptools import Distribution
from setuptools.command.build_ext import build_ext

from harness.compiled import DIRECTORY, MANIFEST, ROOT, TAG, digest_of, source_of

GROUP = "ucp_harness"
LIBRARY = f"{GROUP}__mypyc"
"""The name of the module in which mypyc stores the code of all modules of a group."""
MODULES = (
    "harness.archive.vocabulary",
    "harness.checker._distributed",
    "harness.checker._trace_replay",
    "harness.checker.records._counters",
    "harness.checker.records._heard_vs_sent",
    "harness.checker.reference.algorithms",
    "harness.checker.steps.follower",
    "harness.play._shared_channel",
    "harness.play.simulation._captured_air",
    "harness.play.simulation._event_loop",
    "harness.play.simulation._recurrence",
    "harness.play.simulation.air",
    "harness.play.simulation.incarnations",
    "harness.play.simulation.restored_swarm",
    "harness.play.simulation.simulation",
    "harness.proof.graph._expansion",
    "harness.proof.graph._exploration",
    "harness.proof.model._any_sender",
    "harness.proof.model._block_renaming",
    "harness.proof.model._canonical_order",
    "harness.proof.model._global_states",
    "harness.proof.model._instant",
    "harness.proof.model._known_states",
    "harness.proof.model._local_steps",
    "harness.proof.model._snapshot",
    "harness.proof.model._tallies",
    "harness.proof.model._zones",
    "netem.channel._access",
    "netem.channel._channel",
    "netem.channel._contention",
    "netem.channel._frame",
    "netem.channel._links",
    "netem.medium",
)


def build() -> Path:
    """Compile the modules. Return the directory with the result, which replaces an earlier result."""
    digests = {name: digest_of(source_of(name)) for name in MODULES}  # a later edit makes the result obsolete
    suffix = sysconfig.get_config_var("EXT_SUFFIX")
    os.chdir(ROOT)  # mypy reads pyproject.toml there, and the names of modules begin there
    with TemporaryDirectory() as scratch:
        sources = [str(source_of(name).relative_to(ROOT)) for name in MODULES]
        extensions = mypycify(
            ["--cache-dir", f"{scratch}/cache", *sources],
            opt_level=os.environ.get("MYPYC_OPT_LEVEL", "3"),
            debug_level="0",
            group_name=GROUP,
            target_dir=f"{scratch}/c",
            multi_file=True,
        )
        command = build_ext(Distribution({"name": GROUP, "ext_modules": extensions}))
        command.build_lib, command.build_temp = f"{scratch}/lib", f"{scratch}/objects"
        command.ensure_finalized()
        command.run()
        shutil.rmtree(DIRECTORY, ignore_errors=True)
        DIRECTORY.mkdir()
        for name in (*MODULES, LIBRARY):
            built = Path(scratch, "lib", *name.split("."))
            shutil.copy(built.with_name(built.name + suffix), DIRECTORY / (name + suffix))
    manifest = {"python": TAG, "suffix": suffix, "library": LIBRARY, "sources": digests}
    (DIRECTORY / MANIFEST).write_text(json.dumps(manifest, indent=1) + "\n")
    return DIRECTORY


if __name__ == "__main__":
    sys.stdout.write(f"{build()}\n")
