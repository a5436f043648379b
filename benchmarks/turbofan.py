# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""What the turbofan's faults look like to one-step bounds, and what the excitation has to do with it.

    ./run python benchmarks/turbofan.py [faults] [excitation]

Prints the tables of docs/turbofan.md (Markdown). Healthy and faulty runs share the seed of their noise, so that their
shares of violations are compared pair by pair.
"""

import sys

import numpy as np
from turbofan_fleet import first_sample

from uncertain_lti import EnvelopeMonitor
from uncertain_lti.identification import fit
from uncertain_lti.plants.turbofan_runs import DT, KINDS, Fault, make_run, simulate

AT, SAMPLES, SEED = 24.0, 1401, 20


def pulses(amplitudes, noise):
    return [simulate(make_run("pulses", a, noise, seed=i + 1)) for i, a in enumerate(amplitudes)]


def seen(monitor, run, first, healthy):
    """Cell: samples from the first that can show it to the first violation, to the 2-of-5 alarm, share violated.

    "no" where the share is not clearly above that of the healthy run with the same noise.
    """
    verdicts = monitor.check(run)
    violated, alarm = verdicts.violated[first:], verdicts.alarm[first:]
    share, usual = violated.mean(), monitor.check(healthy).violated[first:].mean()
    if share <= 2.0 * usual + 0.01:
        return f"no ({share:.1%})"
    raised = "already up" if verdicts.alarm[first - 1] else str(np.argmax(alarm) + 1) if alarm.any() else "none"
    return f"{np.argmax(violated) + 1} / {raised} / {share:.0%}"


def faults():
    for noise in (0.0, 1e-4, 1e-3):
        train = [*pulses((0.3, -0.3), noise), simulate(make_run("levels", noise=noise, seed=11))]
        healthy = simulate(make_run("levels", noise=noise, seed=SEED, samples=SAMPLES))
        runs = {
            kind: simulate(make_run("levels", noise=noise, seed=SEED, fault=kind, fault_at=AT, samples=SAMPLES))
            for kind in KINDS
        }
        columns = [(c, a) for a in ("none", "noise", "both") for c in ("qp", "lp")]
        monitors = [EnvelopeMonitor(fit(train, c, additive=a), 2, 5) for c, a in columns]
        onset = round(AT / DT)
        print(f"\nNoise {noise:g}\n\n| | " + " | ".join(f"{c}, {a}" for c, a in columns) + " |")
        print("|---|" + "---|" * len(columns))
        width = [1e4 * np.mean(m.model.fit_summary["mean_width"]) for m in monitors]
        print("| mean width, 1e-4 | " + " | ".join(f"{w:.3g}" for w in width) + " |")
        before = [int(m.check(healthy).violated[:onset].sum()) for m in monitors]
        print(f"| false before, of {onset - 1} | " + " | ".join(str(b) for b in before) + " |")
        for kind, run in runs.items():
            first = first_sample(Fault(kind, AT))
            print(f"| {kind} | " + " | ".join(seen(m, run, first, healthy) for m in monitors) + " |", flush=True)


def excitation():
    for noise, additive in ((0.0, "none"), (1e-4, "noise")):
        check = simulate(make_run("check", noise=noise, seed=5))
        healthy = simulate(make_run("levels", noise=noise, seed=SEED, samples=SAMPLES))
        damaged, worn = (
            simulate(make_run("levels", noise=noise, seed=SEED, fault=kind, fault_at=AT, samples=SAMPLES))
            for kind in ("fan_damage", "compressor_wear")
        )
        print(f"\nNoise {noise:g}, additive {additive}, criterion (10)\n")
        columns = ("pulses", "inside, check", "inside, levels", "outside the domain", "mean width, 1e-4")
        print(f"| {' | '.join(columns)} | fan_damage | compressor_wear |")
        print("|---|---|---|---|---|---|---|")
        for size in (0.05, 0.15, 0.25, 0.3):
            every = {a: simulate(make_run("pulses", a, noise, seed=int(a > 0) + 1)) for a in (size, -size)}
            for name, chosen in (("+", [size]), ("-", [-size]), ("±", [size, -size])):
                monitor = EnvelopeMonitor(fit([every[a] for a in chosen], additive=additive), 2, 5)
                verdicts, long = monitor.check(check), monitor.check(healthy)
                inside = [1.0 - v.violated[v.judged].mean() for v in (verdicts, long)]
                width = (verdicts.upper - verdicts.lower)[verdicts.judged] / monitor.model.operating_point.X
                first = first_sample(Fault("fan_damage", AT))
                print(
                    f"| {name}{size:.0%} | {inside[0]:.0%} | {inside[1]:.1%} | "
                    f"{verdicts.outside_domain[verdicts.judged].mean():.0%} | {1e4 * width.mean():.3g} | "
                    f"{seen(monitor, damaged, first, healthy)} | {seen(monitor, worn, first, healthy)} |",
                    flush=True,
                )


if __name__ == "__main__":
    for part in sys.argv[1:] or ("faults", "excitation"):
        {"faults": faults, "excitation": excitation}[part]()
