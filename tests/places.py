"""Where the documentation and the measured tracks lie."""

import os
from pathlib import Path

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
DATA = Path(os.environ.get("BALLFG_DATA", ROOT.parent / "shared" / "data"))
