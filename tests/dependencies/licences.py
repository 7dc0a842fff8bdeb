"""The licences of the packages that ballfg runs on, against those that its users can live with.

    python -m tests.dependencies.licences

Prints the package, its version and its licence, and exits 1 where one is not among the permissive and weak-copyleft
licences below. The libraries that torch's wheel for GPUs brings are not judged: who installs that wheel wants them.
"""

from __future__ import annotations

import sys
from importlib.metadata import Distribution
from typing import Final

from tests.dependencies.installed import installed

ALLOWED: Final = {
    "mit", "mit license", "mit-cmu", "isc", "isc license", "isc license (iscl)", "0bsd", "zlib", "cc0-1.0", "bsl-1.0",
    "bsd", "bsd license", "bsd-2-clause", "bsd-3-clause", "3-clause bsd license", "simplified bsd license",
    "apache 2.0", "apache 2.0 license", "apache-2.0", "apache software license", "apache-2.0 with llvm-exception",
    "psf-2.0", "python software foundation license", "cnri-python", "mpl-2.0", "mozilla public license 2.0 (mpl 2.0)",
    "lgpl-2.1-or-later", "lgpl-3.0-or-later", "lgpl-3.0-only", "any-osi",
}  # fmt: skip
"""In lower case. The weakest ties are those of MPL and LGPL: changes to the package itself must be open."""

GPU: Final = ("nvidia-", "cuda-")
"""Beginnings of names: NVIDIA's libraries, under its own licence. Only torch's wheel for its GPUs brings them."""


def licence_of(package: Distribution) -> str:
    """What a package says of its licence: an SPDX expression, else a short name, else its classifiers; or nothing."""
    about = package.metadata
    for field in ("License-Expression", "License"):
        said = about.get(field) or ""
        if said and "\n" not in said and len(said) < 200:
            return said.strip()
    kinds = [line.rpartition(" :: ")[2] for line in about.get_all("Classifier") or () if line.startswith("License")]
    return " AND ".join(dict.fromkeys(kinds))


def is_allowed(licence: str) -> bool:
    """Whether all parts of an expression are allowed, or one of its alternatives.

    An expression with alternatives in brackets is not allowed: it is to be read by a person.
    """
    if "(" in licence and " OR " in licence:
        return False
    alternatives = licence.split(" OR ")
    return any(
        all(part.strip().lower() in ALLOWED for part in alternative.split(" AND ")) for alternative in alternatives
    )


def main() -> int:
    """Prints the list. Returns: 1 where a licence is not allowed or not stated."""
    wrong = 0
    for name, package in sorted(installed().items()):
        licence = licence_of(package)
        good = is_allowed(licence) or name.startswith(GPU)
        wrong += not good
        print(f"{name:28} {package.version:16} {licence or 'states no licence'}{'' if good else '   NOT ALLOWED'}")
    print(f"{wrong} licences are not among the allowed ones")
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
