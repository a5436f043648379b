# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""The paper's solver (direct search, golden-section line searches) and the exact one: objective of (10) and time.

./run python benchmarks/direct_search.py
"""

import time

from uncertain_lti.identification import fit
from uncertain_lti.identification.direct_search import direct_search
from uncertain_lti.plants import leibov
from uncertain_lti.plants.turbofan_runs import make_run, simulate
from uncertain_lti.reports.tables import table


def main() -> None:
    pulses = {a: simulate(make_run("pulses", a)) for a in (0.05, -0.05, 0.3, -0.3)}
    problems = {
        "turbofan, +5 %": [pulses[0.05]],
        "turbofan, ±5 %": [pulses[0.05], pulses[-0.05]],
        "turbofan, ±30 %": [pulses[0.3], pulses[-0.3]],
        "published intervals, 30 s": [leibov.transient(1201, 1)],
        "published intervals, 150 s": [leibov.transient(6001, 1)],
    }
    fit(problems["turbofan, +5 %"])  # imports the solvers
    rows = []
    for name, transients in problems.items():
        began = time.perf_counter()
        model = fit(transients)
        exact = time.perf_counter() - began
        found = direct_search(transients)
        rows.append(
            [
                name,
                str(model.fit_summary["transitions"]),
                f"{model.fit_summary['objective']:.5g}",
                f"{found.objective:.5g}",
                f"{found.objective / model.fit_summary['objective'] - 1:+.2%}",
                f"{exact:.2f}",
                f"{found.seconds:.1f}",
                f"{found.seconds / exact:.0f}",
                str(found.evaluations),
            ]
        )
    header = ("", "N", "exact (10)", "direct search", "above", "exact [s]", "direct [s]", "ratio", "evaluations")
    print(table(header, rows))


if __name__ == "__main__":
    main()
