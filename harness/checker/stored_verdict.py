"""Compare the verdict in run.json with a new verdict on the files of the run.

The same version of the checker gives the same verdict on the same files. A difference then means that a file was edited
after the run. A different version of the checker may also give a different verdict.
"""

from collections.abc import Iterator

from harness.archive.run_record import RunRecord, Survival
from harness.checker._verdict import Result
from harness.scenario.verdict_names import ALL_CHECKS, CHARACTERISTICS


def differences(record: RunRecord, result: Result, survived: Survival) -> Iterator[str]:
    """Yield a sentence for each stored verdict or numeric result that differs from the new one. A run without a stored
    verdict has no difference.
    """
    if not record.characteristics:
        return
    for key, judgement in result.judgements.items():
        stored = record.judgements.get(key)
        if stored is not None and stored.verdict != judgement.verdict:
            name = f"characteristic {key}" if key in CHARACTERISTICS else f"`{ALL_CHECKS[key]}`"
            yield f"run.json has {stored.verdict!r} for {name}, but its files give {judgement.verdict!r}"
    for name, figure in result.figures.items():
        if name in record.figures and record.figures[name] != figure:
            yield f"run.json has {record.figures[name]} as figure {name}, but its files give {figure}"
    if record.survival is not None and record.survival != survived:
        yield "run.json has another survival of blocks than its files give"
