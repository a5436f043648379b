# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Transients as the steps that a sampler gives, for what is judged one by one."""

from __future__ import annotations

import numpy as np

from uncertain_lti.sampling.sampler import Step
from uncertain_lti.sampling.transient import Transient


def steps_of(transient: Transient) -> list[Step]:
    """As the sampler gives them."""
    found = []
    z = np.hstack([transient.x, transient.u, transient.s])
    for k, status in enumerate(transient.statuses()):
        none = [float("nan")] * z.shape[1]
        before = z[k - 1].tolist() if k and not status.opens_segment else none
        dt = (transient.t_ns[k] - transient.t_ns[k - 1]) * 1e-9 if k else float("nan")
        found.append(Step(status, int(transient.t_ns[k]), 0, float(dt), before, transient.x[k].tolist()))
    return found
