"""Lets pytest, and every process a test starts, import the packages of this checkout without installing it.

``tests/checkout`` links ``uncertain_lti`` to ``core/``; mypy finds the package through the same folder.
"""

import os
import sys
from pathlib import Path

_CHECKOUT = str(Path(__file__).resolve().parent / "tests" / "checkout")

sys.path.insert(0, _CHECKOUT)
os.environ["PYTHONPATH"] = os.pathsep.join(filter(None, [_CHECKOUT, os.environ.get("PYTHONPATH")]))

# Threads of OpenBLAS that wait for one another spin, and the tests already share the cores: four times as slow.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
