"""A campaign of random faults: recordings, documents, signals, disks and memory, against the commands and the console.

``python -m tests.faults --n N --seed S`` runs it; docs/reliability.md describes it and shows its results.
"""

from __future__ import annotations

import sys
from pathlib import Path

if (TESTS := str(Path(__file__).parents[1])) not in sys.path:  # what the tests share, as pytest finds it
    sys.path.insert(0, TESTS)
