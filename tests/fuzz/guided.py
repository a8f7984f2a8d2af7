"""Fuzz a target with coverage guidance: `python -m tests.fuzz.guided [--blind] TARGET [libFuzzer's options] FOLDER...`

libFuzzer makes half of the mutations, and `tests.fuzz.mutations` makes the other half. For comparison, `--blind`
mutates the stored inputs at random and ignores the coverage. The last line that libFuzzer prints is the path of the
failing input.
"""

import faulthandler
import random
import signal
import sys

import atheris

PACKAGES = ["ucp", "harness", "netem", "sitl"]


def main(arguments: list[str]) -> None:
    blind = arguments[0] == "--blind"
    name, *options = arguments[blind:]
    with atheris.instrument_imports(include=PACKAGES):
        from tests.fuzz.corpus import files_of
        from tests.fuzz.mutations import damaged
        from tests.fuzz.targets import named

        target = named(name)
        kept = [path.read_bytes() for path in files_of(name)]
        for data in kept:
            target.run(data)  # instruments the modules that the target imports late
    chance = random.Random()

    def mutate(data: bytes, most_bytes: int, seed: int) -> bytes:
        if blind:
            return damaged(chance.choice(kept), chance)[:most_bytes]
        if chance.random() < 0.5:
            mutated: bytes = atheris.Mutate(data, most_bytes)
            return mutated
        return damaged(data, chance)[:most_bytes]

    faulthandler.register(signal.SIGUSR1)
    atheris.Setup([sys.argv[0], *options], target.run, custom_mutator=mutate)
    atheris.Fuzz()


if __name__ == "__main__":
    main(sys.argv[1:])
