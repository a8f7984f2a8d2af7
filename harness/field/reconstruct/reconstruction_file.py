"""The reconstruction as a file: a scenario with a comment at its top that says from what it was made."""

from collections.abc import Iterator, Sequence
from pathlib import Path
from textwrap import wrap

from harness.errors import MachineError
from harness.field.reconstruct.reconstruct import SEED, Reconstruction
from harness.scenario.scenario_file import to_yaml

WIDTH = 116


def write(reconstruction: Reconstruction, path: Path, sources: Sequence[Path], left_out: Sequence[str]) -> None:
    """Raises MachineError if the file cannot be written."""
    sentences = _sentences(reconstruction, path, sources, left_out)
    comment = [line for sentence in sentences for line in wrap(sentence, WIDTH)]
    try:
        path.write_text(to_yaml(reconstruction.document, comment), encoding="utf-8")
    except OSError as error:
        raise MachineError(f"{path} cannot be written: {error.strerror}") from None


def _sentences(
    reconstruction: Reconstruction, path: Path, sources: Sequence[Path], left_out: Sequence[str]
) -> Iterator[str]:
    yield f"Made by `ucp-harness reconstruct` from {', '.join(map(str, sources))}: it {reconstruction.sentence}."
    yield from (f"- {problem}" for problem in reconstruction.problems[1:])
    yield from (f"- {remark}" for remark in reconstruction.remarks)
    yield from (f"- not used: {sentence}" for sentence in left_out)
    yield "Nobody is reached but by `fates` and `datagrams`; messages that no handler does anything with are left out."
    yield "`expect` is what happened. Where that is a mistake which is mended now, say what should happen instead."
    yield f"  ucp-harness run {path} --backend sim --seed {SEED}"
    yield f"  pytest {path}"
