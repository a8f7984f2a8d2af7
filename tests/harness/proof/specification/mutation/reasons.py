"""Some edits of the specification change no behaviour, because the specification has certain invariants. Check these
invariants with TLC.
"""

from collections.abc import Mapping, Sequence

from harness.proof.specification import _tlc, _validate
from harness.proof.specification._recorded_incarnations import module
from harness.proof.specification._second_opinion import _config
from tests.harness.proof.specification.mutation.comparisons import Inputs, States

MODULE = "Invariants"


def violated_in(comparison: States | Inputs, invariants: Sequence[str]) -> int | None:
    """Return the index of an invariant that a state of the comparison violates. Return None if all invariants hold.

    Each invariant is a TLA+ expression about the agent `a`.
    """
    names = [f"Invariant{number}" for number in range(len(invariants))]
    if isinstance(comparison, States):
        base, config = "Swarm", _config(comparison.bounds).partition("INVARIANTS")[0]
        modules: Mapping[str, str] = {}
        each = "\\A id \\in Everybody : LET a == swarm[id] IN"
    else:
        constants, batch = comparison.encoded
        base, config = "Recorded", _validate._config(constants)
        modules = {"Lives": module(batch.lives, batch.chains)}
        each = "LET a == agent IN"
    text = [f"---- MODULE {MODULE} ----", f"EXTENDS {base}"]
    text += [f"{name} == {each} {invariant}" for name, invariant in zip(names, invariants, strict=True)]
    others = {**modules, MODULE: "\n".join([*text, "====", ""])}
    with _tlc.checked(MODULE, "\n".join([config, "INVARIANTS", *names, ""]), others=others) as result:
        return names.index(result.violated) if result.violated else None
