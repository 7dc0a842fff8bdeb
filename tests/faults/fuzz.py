"""Damaged files for every reader of ballfg: each is read, or refused in one line that names it.

    python -m tests.faults.fuzz --seconds 600 --seed 1

A fault - another exception, over 2 s of the processor, over 1 GB of memory, a crash - is printed, its file goes into
`tests/faults/corpus/`, and the exit status is 1. The same seed damages in the same way.
"""

from __future__ import annotations

import argparse
import gzip
import hashlib
import random
import shutil
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

from tests.faults.mutations import damaged
from tests.faults.odd_seeds import write_odd
from tests.faults.readers import reader_of
from tests.faults.seeds import write_seeds
from tests.faults.worker import Worker, in_a_process, verdict

CORPUS = Path(__file__).with_name("corpus")
LARGEST = 64_000
"""Bytes of a file of the corpus, compressed."""
REPLACEMENTS = ("empty", "gone", "folder", "own link", "lost link", "unreadable", "zeros")
"""What a file is replaced by, beside damage to its content."""


@dataclass
class Counts:
    """How cases ended."""

    outcomes: Counter[str] = field(default_factory=Counter)
    faults: dict[str, str] = field(default_factory=dict)
    """One case of each sort of fault, by its message."""


class Fuzzer:
    """Readers with their good files in a folder.

    Args: folder: to make; it is written to.  only: readers whose name begins so.
    """

    def __init__(self, folder: Path, only: str = "") -> None:
        self._seeds, self._odd, self._place = folder / "seeds", folder / "odd", folder / "cases"
        in_a_process(self._write)
        shutil.copytree(self._seeds, self._place, symlinks=True)
        self.files = sorted(
            (place.name, str(file.relative_to(place)))
            for place in self._seeds.iterdir()
            if place.name.startswith(only)
            for file in place.rglob("*")
            if file.is_file()
        )
        self.counts = Counts()
        self._worker = Worker(self._judge, self._warm)

    def run(self, seconds: float, seed: int, corpus: Path = CORPUS) -> None:
        """Damages files until the time is over."""
        rng, end = random.Random(seed), time.monotonic() + seconds
        odd = sorted(file for file in (*self._odd.iterdir(), *self._seeds.rglob("*")) if file.is_file())
        while time.monotonic() < end:
            reader, name = rng.choice(self.files)
            good = (self._seeds / reader / name).read_bytes()
            ending = Path(name).suffix
            if rng.random() < 0.05:
                alike = [file for file in odd if file.suffix == ending]
                content = rng.choice(alike if rng.random() < 0.8 else odd).read_bytes()
            else:
                content = damaged(good, ending, rng)
            found = self.case(reader, name, content)
            if found[0] == "fault":
                _keep(corpus, reader, name, content)

    def replaced(self) -> None:
        """Every file empty, gone, a folder, a link to itself or to nothing, unreadable, or of zeros."""
        for reader, name in self.files:
            for kind in REPLACEMENTS:
                self._replace(self._place / reader / name, kind)
                self._ended(reader, name, kind)

    def case(self, reader: str, name: str, content: bytes) -> tuple[str, str]:
        """What becomes of a reader whose file has another content."""
        (self._place / reader / name).write_bytes(content)
        return self._ended(reader, name, hashlib.sha256(content).hexdigest()[:8])

    def close(self) -> None:
        """Ends the process that reads."""
        self._worker.close()

    def _write(self) -> None:
        write_seeds(self._seeds)
        write_odd(self._odd)

    def _replace(self, file: Path, kind: str) -> None:
        if kind == "unreadable":
            file.chmod(0)
        elif kind in ("empty", "zeros"):
            file.write_bytes(bytes(1000 * (kind == "zeros")))
        else:
            file.unlink()
            if kind == "folder":
                file.mkdir()
            elif kind != "gone":
                file.symlink_to(file.name if kind == "own link" else "nowhere")

    def _ended(self, reader: str, name: str, what: str) -> tuple[str, str]:
        """Reads the case and puts the good file back."""
        found = self._worker(reader, name)
        place = self._place / reader / name
        if place.is_dir() and not place.is_symlink():
            place.rmdir()
        else:
            place.unlink(missing_ok=True)
        shutil.copyfile(self._seeds / reader / name, place)
        self.counts.outcomes[found[0]] += 1
        if found[0] == "fault":
            self.counts.faults.setdefault(f"{reader}: {found[1]}", f"{name}, {what}")
        return found

    def _judge(self, reader: str, name: str) -> tuple[str, str]:
        folder, wanted = self._place / reader, reader_of(reader)
        names = (Path(name).name, str(folder)) if wanted.names_file else ()
        return verdict(lambda: wanted.read(folder, folder / name), names)

    def _warm(self) -> None:
        """Each reader reads its good files once: what it imports and compiles is no part of a case."""
        for reader, name in self.files:
            folder = self._seeds / reader
            try:
                reader_of(reader).read(folder, folder / name)
            except Exception as error:
                raise RuntimeError(f"{reader}, {name}: {error!r}") from None


def corpus_cases(corpus: Path = CORPUS) -> Iterator[tuple[str, str, bytes]]:
    """Reader, file and content of each case of the corpus."""
    for file in sorted(corpus.glob("*.gz")):
        reader, name, _ = file.name.split("__")
        yield reader, name.replace("+", "/"), gzip.decompress(file.read_bytes())


def _keep(corpus: Path, reader: str, name: str, content: bytes) -> None:
    packed = gzip.compress(content, mtime=0)
    if len(packed) <= LARGEST:
        digest = hashlib.sha256(content).hexdigest()[:8]
        (corpus / f"{reader}__{name.replace('/', '+')}__{digest}.gz").write_bytes(packed)


def main() -> int:
    """Runs from the command line. Returns: 1 where there was a fault."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=600.0, help="how long files are damaged")
    parser.add_argument("--seed", type=int, default=1, help="of all choices")
    parser.add_argument("--only", default="", help="names of readers begin so")
    parser.add_argument("--corpus", type=Path, default=CORPUS, help="folder for files with faults")
    parser.add_argument("--replay", action="store_true", help="first the corpus, and every file replaced as a whole")
    options = parser.parse_args()
    options.corpus.mkdir(exist_ok=True)
    with tempfile.TemporaryDirectory() as folder:
        fuzzer = Fuzzer(Path(folder), options.only)
        if options.replay:
            for reader, name, content in corpus_cases(options.corpus):
                if reader.startswith(options.only):
                    fuzzer.case(reader, name, content)
            fuzzer.replaced()
        fuzzer.run(options.seconds, options.seed, options.corpus)
        fuzzer.close()
    counts = fuzzer.counts
    for message, where in sorted(counts.faults.items()):
        print(f"FAULT {message}\n      {where}")
    tally = ", ".join(f"{counts.outcomes[kind]} {kind}" for kind in ("read", "refused", "fault"))
    print(f"{len(fuzzer.files)} files of {len({one for one, _ in fuzzer.files})} readers: {tally}")
    return 1 if counts.faults else 0


if __name__ == "__main__":
    sys.exit(main())
