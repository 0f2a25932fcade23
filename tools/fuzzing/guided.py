"""One target fuzzed guided by coverage: ``python -m tools.fuzz --atheris --target NAME`` ends up here.

It is a process of its own because the readers have to be imported under atheris' eyes.
"""

import sys
import tempfile
from pathlib import Path
from random import Random

import atheris

with atheris.instrument_imports(
    include=["frontend.readers", "mrtm.config", "mrtm.plain_yaml", "mrtm.evaluation", "mrtm.team"]
):
    from tools.fuzzing.targets import holds, targets

from tools.fuzzing.mutate import LARGEST, mutate


def main(name: str, count: str, seed: str, out: str) -> None:
    """Feed a target with ``count`` inputs; libFuzzer ends the process and writes what found something to ``out``."""
    target = next(target for target in targets() if target.name == name)
    directory = Path(tempfile.mkdtemp(prefix="mrtm-fuzz-"))  # atheris ends the process without leaving a block
    file = directory / "input"
    corpus = directory / "corpus"
    corpus.mkdir()
    for number, content in enumerate(target.seeds):
        (corpus / str(number)).write_bytes(content)
    Path(out).mkdir(parents=True, exist_ok=True)

    def one_input(data: bytes) -> None:
        file.write_bytes(data)
        holds(target, file)

    def mutated(data: bytes, largest: int, number: int) -> bytes:
        random = Random(number)
        if random.random() < 0.5:
            return mutate(random, [bytes(data), *target.seeds])[:largest]
        return bytes(atheris.Mutate(data, largest))

    limits = [
        "-timeout=10",
        "-rss_limit_mb=2048",
        f"-max_len={LARGEST}",
        f"-artifact_prefix={out}/",
        "-print_final_stats=1",
    ]
    arguments = [sys.argv[0], f"-runs={count}", f"-seed={int(seed) + 1}", *limits, str(corpus)]  # 0 is a random seed
    atheris.Setup(arguments, one_input, custom_mutator=mutated)
    atheris.Fuzz()


if __name__ == "__main__":
    main(*sys.argv[1:])
