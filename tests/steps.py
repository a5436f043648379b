# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Transients and the steps that a sampler gives: the one as the other, and the one held against the other."""

from collections.abc import Sequence

import numpy as np

from uncertain_lti.sampling.clock import Status
from uncertain_lti.sampling.sampler import Step
from uncertain_lti.sampling.transient import Transient

OPENING = (Status.FIRST, Status.RESET, Status.GAP)
"""Of a sample without a predecessor."""


def steps_of(transient: Transient) -> list[Step]:
    """As the sampler gives them."""
    found = []
    z = np.hstack([transient.x, transient.u, transient.s])
    for k, status in enumerate(transient.statuses()):
        none = [float("nan")] * z.shape[1]
        before = z[k - 1].tolist() if k and status not in OPENING else none
        dt = (transient.t_ns[k] - transient.t_ns[k - 1]) * 1e-9 if k else float("nan")
        found.append(Step(status, int(transient.t_ns[k]), 0, float(dt), before, transient.x[k].tolist()))
    return found


def holds(transient: Transient, steps: Sequence[Step]) -> None:
    """The transient has what these steps say of every sample that was kept, to the last bit."""
    kept = [s for s in steps if not s.status.dropped]
    assert transient.statuses() == [s.status for s in kept]
    assert transient.t_ns.tolist() == [s.t_ns for s in kept]
    np.testing.assert_array_equal(transient.x, np.reshape([s.x_next for s in kept], transient.x.shape))
    for k, step in enumerate(kept[1:]):
        if step.status is not Status.RESET:
            np.testing.assert_array_equal(transient.u[k], step.u)
