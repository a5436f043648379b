# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

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

# As some containers set it: every process of the tests would compile numpy and scipy again, which doubles its start.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
sys.dont_write_bytecode = False
