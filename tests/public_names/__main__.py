"""Lists what public names lack: `python -m tests.public_names`, or with rooms such as `ballfg.tracks` as arguments."""

import sys

from tests.public_names.check import ROOMS, report

for room in sys.argv[1:] or ROOMS:
    print(report(room))
