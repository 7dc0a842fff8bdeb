"""Types all blocks of the README, from top to bottom, into a shell in a fresh clone; `make readme`.

It needs nothing that is not in Python itself, as on a bare machine.
"""

import re
import subprocess
import sys
import tempfile
import time
from pathlib import Path

ROOT = Path(__file__).parents[1]


def script(text: str) -> str:
    """The blocks of a document as one shell script that stops at the first failure."""
    parts = ["set -e"]
    for language, code in re.findall(r"```(python|)\n(.*?)```", text, re.DOTALL):
        parts.append(f"python - <<'END'\n{code}END" if language else code.rstrip())
    return "\n".join(parts) + "\n"


def main() -> int:
    """Returns: the exit status of the script."""
    with tempfile.TemporaryDirectory() as folder:
        clone = Path(folder) / "ballfg"
        subprocess.run(["git", "clone", "--quiet", str(ROOT), str(clone)], check=True)
        begin = time.monotonic()
        text = script((clone / "README.md").read_text(encoding="utf-8"))
        status = subprocess.run(["bash", "-v", "-c", text], cwd=clone).returncode
        print(f"exit status {status} after {(time.monotonic() - begin) / 60:.1f} minutes")
    return status


if __name__ == "__main__":
    sys.exit(main())
