"""Known vulnerabilities of the packages that ballfg runs on, as `pip-audit` finds them in public databases.

    python -m tests.dependencies.audit PIP_AUDIT [--strict]

PIP_AUDIT is the program's path. Without a network, or with a registry that knows nothing of vulnerabilities, packages
are not audited; that is printed, and with --strict it is a failure as well. The exit status is 1 for a vulnerability.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from packaging.version import Version

from tests.dependencies.installed import installed


def run_audit(program: str, packages: Sequence[str]) -> tuple[list[Mapping[str, Any]], str]:
    """The packages as pip-audit judges them, and the last line that it said where it judged none."""
    with tempfile.TemporaryDirectory() as folder:
        listed = Path(folder) / "packages.txt"
        listed.write_text("\n".join(packages) + "\n", encoding="utf-8")
        command = [program, "-r", str(listed), "--no-deps", "--disable-pip", "--format", "json", "--progress-spinner"]
        done = subprocess.run([*command, "off"], capture_output=True, text=True, check=False)
    try:
        return json.loads(done.stdout)["dependencies"], ""
    except (ValueError, KeyError):
        said = done.stderr.strip().splitlines()
        return [], said[-1] if said else f"it ended with status {done.returncode}"


def report(judged: Sequence[Mapping[str, Any]], count: int, said: str, *, strict: bool) -> int:
    """Prints what was found. Returns: the exit status.

    Args: judged: the packages, as pip-audit judges them.  count: of the packages that were given to it.
        said: why it judged none, where that is so.  strict: whether packages that were not audited are a failure.
    """
    known = [one for one in judged if one.get("vulns")]
    for one in known:
        for found in one["vulns"]:
            mended = ", ".join(found.get("fix_versions") or ()) or "no version yet"
            print(f"VULNERABLE {one['name']} {one['version']}: {found['id']}, mended in {mended}")
    skipped = [one for one in judged if one.get("skip_reason")]
    audited = len(judged) - len(skipped)
    print(f"{audited} of {count} packages audited, {len(known)} with known vulnerabilities")
    if audited < count:
        why = said or next((str(one["skip_reason"]) for one in skipped), "it does not say why")
        print(f"AUDIT SKIPPED for {count - audited} packages: {why}. Run it where the database can be reached.")
    return 1 if known or (strict and audited < count) else 0


def main() -> int:
    """Runs from the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("program", help="path of pip-audit")
    parser.add_argument("--strict", action="store_true", help="packages that are not audited are a failure")
    options = parser.parse_args()
    packages = [f"{name}=={Version(package.version).public}" for name, package in sorted(installed().items())]
    judged, said = run_audit(options.program, packages)
    return report(judged, len(packages), said, strict=options.strict)


if __name__ == "__main__":
    sys.exit(main())
