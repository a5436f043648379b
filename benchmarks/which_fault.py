# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Which fault: how often an alarm of the turbofan is named as what it is, and how often as something else.

    ./run python benchmarks/which_fault.py    # the table of docs/turbofan.md, some minutes

The model is fitted to two pulse runs and lever profiles at random; signatures are learnt from two runs of each fault at
its usual size. Tried are other seeds, other lever profiles, half and twice the size, and healthy runs; then once more
with the signature of that fault taken away, which must leave it unknown.
"""

from __future__ import annotations

from dataclasses import replace

from measure import table
from turbofan_fleet import simulate_fleet

from uncertain_lti import EnvelopeMonitor, Transient, UncertainLTI, fit
from uncertain_lti.monitor.likeness import LEAST
from uncertain_lti.plants.turbofan_faults import KINDS, Fault
from uncertain_lti.plants.turbofan_runs import LARGE, NOISE, Run, lever_moves, make_run
from uncertain_lti.reports.check_data import check_data
from uncertain_lti.validation.signatures import learn_signatures

SIZES, SEEDS, TAUGHT, ONSET, SECONDS = (0.5, 1.0, 2.0), 6, 2, 8.0, 25.0


def fitted() -> UncertainLTI:
    """Pulses and profiles, one step and ten and forty of them."""
    pulses = simulate_fleet([make_run("pulses", sign * LARGE, NOISE, seed) for sign, seed in ((1, 1), (-1, 2))])
    profiles = simulate_fleet(
        [Run(1601, lever=lever_moves(40, 100 + i), ramps=True, noise=NOISE, seed=100 + i) for i in range(8)]
    )
    return fit([*pulses, *profiles], additive="both", horizons=[10, 40])


def runs(kind: str, size: float) -> list[Run]:
    """One fault on other profiles than any fitted."""
    fault = Fault(kind, ONSET, size) if kind else None
    seeds = range(1000, 1000 + SEEDS)
    return [
        Run(int(SECONDS / 0.025) + 1, lever=lever_moves(SECONDS, s), ramps=True, noise=NOISE, seed=7 * s, fault=fault)
        for s in seeds
    ]


def named(model: UncertainLTI, monitor: EnvelopeMonitor, transient: Transient) -> str | None:
    """The label of the longest alarm; empty for unknown, None without an alarm long enough."""
    found = check_data(model, monitor.check(transient), samples=False)["explained"]
    longest = max(found, key=lambda like: like["verdicts"], default=None)
    return None if longest is None or longest["verdicts"] < LEAST else longest["label"] or ""


def main() -> None:
    """Print the table."""
    model = fitted()
    cases = [(kind, size) for kind in KINDS for size in SIZES if size == 1.0 or not kind.endswith("stuck")]
    every = [run for kind, size in cases for run in runs(kind, size)] + runs("", 1.0)
    transients = simulate_fleet(every)
    of = {case: transients[SEEDS * i : SEEDS * (i + 1)] for i, case in enumerate([*cases, ("", 1.0)])}
    for steps in ((), (10,), (10, 40)):
        some = model.replace(horizons=[h for h in model.horizons if h.steps in steps])
        rules = [replace(some.alarm_rule, violations=2, window=5)]
        rules += [replace(rules[0], violations=5, window=10, margin=1.1, horizon=h) for h in steps]
        some = some.replace(alarm=rules)
        monitor = EnvelopeMonitor(some)
        learnt = learn_signatures(
            some, [(k, v) for k in KINDS for t in of[k, 1.0][:TAUGHT] if (v := monitor.check(t)).alarm.sum() >= LEAST]
        )
        taught = some.replace(signatures=learnt.signatures)
        rows = []
        for (kind, size), tried in of.items():
            if size == 1.0 and kind:
                tried = tried[TAUGHT:]
            found = [named(taught, EnvelopeMonitor(taught), t) for t in tried]
            without = taught.replace(signatures=[s for s in taught.signatures if s.label != kind])
            blind = [named(without, EnvelopeMonitor(without), t) for t in tried] if kind else []
            rows.append(
                [
                    kind or "healthy", f"{size:g}", str(len(tried)), str(sum(f is not None for f in found)),
                    str(sum(f == kind for f in found)) if kind else "-", str(sum(f == "" for f in found)),
                    str(sum(f not in (None, "", kind) for f in found)), str(sum(f not in (None, "") for f in blind)),
                ]
            )  # fmt: skip
        table(
            f"one step{''.join(f', {h} steps' for h in steps)}",
            ("fault", "size", "runs", "alarm", "named right", "unknown", "named wrong", "named without its signature"),
            rows,
        )


if __name__ == "__main__":
    main()
