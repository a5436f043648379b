# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""What envelopes over several steps see that one step does not: widths, coverage, delays and cost.

./run python benchmarks/horizons.py bags          # the shipped recordings of the turbofan's faults
./run python benchmarks/horizons.py live          # CPU time of a verdict with horizons, against one step
./run python benchmarks/horizons.py node          # CPU time of the node for a sample, through DDS
./run python benchmarks/horizons.py fit           # CPU time of a fit of ten horizons, against one step
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
from live_monitor import TOPICS, Child, Run, save_model
from measure import table

from uncertain_lti import EnvelopeMonitor, Transient, UncertainLTI, fit, read_transients
from uncertain_lti.model.alarm_rule import AlarmRule, StatisticRule
from uncertain_lti.model.horizon import Horizon, Residuals
from uncertain_lti.model.terms import ARRAYS, SHAPES
from uncertain_lti.plants.turbofan_runs import DT, Fault, turbofan_signals
from uncertain_lti.validation.left_out import cut

ROOT = Path(__file__).resolve().parents[1]
SHIPPED = ("pulses_up_large", "pulses_down_large", "levels")
HORIZONS = (10, 20, 40)
FAULTS = ("compressor_wear", "sensor_drift", "nozzle_stuck", "fan_damage")
ONSET = 24.0


def judged(model: UncertainLTI, first: list[str], clean: list[Any], broken: dict[str, list[Any]]) -> list[list[str]]:
    """Rows of the table, one per horizon."""
    monitor = EnvelopeMonitor(model)

    def outside(transient: Any) -> Any:
        table_of = monitor.check(transient).horizon_utilisation
        return (np.abs(table_of) > 1.0).any(axis=2), ~np.isnan(table_of).all(axis=2)

    healthy = [outside(t) for t in clean]
    faulty = {fault: [outside(t) for t in runs] for fault, runs in broken.items()}
    widths = [model.fit_summary["mean_width"], *(h["mean_width"] for h in model.fit_summary["horizons"])]
    rows = []
    for j, h in enumerate((1, *model.steps)):
        shares = [1.0 - out[:, j].sum() / there[:, j].sum() for out, there in healthy]
        cells = []
        for fault, found in faulty.items():
            onset = Fault(fault, ONSET).first_sample(DT)
            delays, later = [], []
            for out, _ in found:
                after = out[onset:, j]
                delays.append(f"{(int(np.argmax(after)) + 1) * DT:.2g}" if after.any() else "never")
                later.append(100 * after.mean())
            cells.append(f"{', '.join(delays)}; {min(later):.0f}-{max(later):.0f} %")
        half = " ".join(f"{5e3 * w:.0f}" if w >= 2e-3 else f"{5e3 * w:.1f}" for w in widths[j])
        rows.append([*first, str(h), half, f"{100 * min(shares):.1f}-{100 * max(shares):.1f} %", *cells])
    return rows


def bags() -> None:
    """Fitted to the three shipped noisy recordings, constant half-widths; the shipped recordings of faults."""
    fitted = read_transients([ROOT / f"bags/turbofan_{name}_noise.mcap" for name in SHIPPED], turbofan_signals())
    broken = {fault: read_transients(ROOT / f"bags/turbofan_{fault}.mcap", turbofan_signals()) for fault in FAULTS}
    rows = []
    for criterion, knots in (("lp", 1), ("qp", 1), ("qp", 3)):
        schedule: Any = {} if knots == 1 else {"fan_speed": knots}
        options: Any = {"additive": "noise", "schedule": schedule, "horizons": HORIZONS, "widths": "constant"}
        model = fit(fitted, criterion, alarm="containment", **options)  # type: ignore[arg-type]
        before = [cut(t, 0, round(ONSET / DT)) for ts in broken.values() for t in ts]
        rows += judged(model, [criterion, str(knots)], before, broken)
    header = ["criterion", "knots", "steps", "N1 N2 P3 P5 T5, 1e-4", "inside before"]
    table(
        f"Shipped recordings, faults from {ONSET:g} s on: delay to the first window outside, s; share outside after it",
        [*header, *(f.replace("_", " ") for f in FAULTS)],
        rows,
    )


def live() -> None:
    """One verdict after another: with horizons of 10, 20 and 40 steps, and without."""
    rows = []
    rng = np.random.default_rng(0)
    for n, m in ((5, 4), (50, 10)):
        arrays = {name: 0.01 * np.abs(rng.normal(size=SHAPES[name].shape(n, m))) for name in ARRAYS}
        plain = UncertainLTI(**arrays)
        model = plain.replace(horizons=[Horizon(h, **arrays) for h in HORIZONS])
        before, after = rng.normal(size=n + m).tolist(), rng.normal(size=n).tolist()
        times = []
        for one in (plain, model):
            judge = one.judge_of(1.0, np.ones(n, dtype=bool))
            runs, best = one.runs_of(judge), np.inf
            for _ in range(5):
                began = time.process_time()
                for _ in range(2000):
                    judge.judge(before, after, 0.002)
                    if runs is not None:
                        runs.push(before, after, 0.002)
                best = min(best, time.process_time() - began)
            times.append(best / 2000)
        rows.append([str(n), str(m), *(f"{1e6 * t:.2f} µs" for t in times)])
    table("CPU time of a verdict", ["n", "m", "one step", f"with horizons of {HORIZONS} steps"], rows)


class HorizonRun(Run):
    """A monitor with horizons of 10, 20 and 40 steps, and chi2 and the mean of the longest in its alarm."""

    longer = False

    def monitor(self, folder: str, which: str = "") -> Child:
        """The node of this checkout."""
        path = Path(folder) / "bench.model.json"
        save_model(path, self.n, self.rate)
        if self.longer:
            plain = UncertainLTI.load(path)
            arrays = {name: 0.1 * np.abs(getattr(plain, name)) + 1e-3 for name in ARRAYS}
            known = Residuals(np.zeros(self.n), np.eye(self.n))
            rules = [StatisticRule("chi2", 0.0, 1e6, HORIZONS[-1]), StatisticRule("mean", 2.0, 1e3, HORIZONS[-1])]
            plain.replace(
                horizons=[Horizon(h, **arrays, residuals=known) for h in HORIZONS], alarm=[AlarmRule(), *rules]
            ).save(path)
        code = "import sys; from uncertain_lti_ros.envelope_monitor import main; sys.exit(main())"
        return self.child("-P", "-c", code, "--ros-args", "-p", f"model:={path}", "-p", "violations:=1")


class LongerRun(HorizonRun):
    """As above, with the horizons."""

    longer = True


def node() -> None:
    """A sample at 500 Hz through the node: CPU time with horizons and two statistics over that with one step."""
    rows = []
    for n in (5, 50):
        for heard in (["violation"], TOPICS):
            turns = []
            for _ in range(5):
                found = [
                    kind(n, 500.0, 8.0).measure("monitor", "", list(heard))["cpu"] for kind in (HorizonRun, LongerRun)
                ]
                turns.append(found)
                print(n, len(heard), found, file=sys.stderr, flush=True)
            one, more = np.median(np.array(turns), axis=0)
            ratio = float(np.median([b / a for a, b in turns]))
            what = "~/violation" if len(heard) == 1 else "all outputs"
            rows.append([str(n), what, f"{one:.0f} µs", f"{more:.0f} µs", f"{ratio:.2f}"])
    header = ["n", "heard", "one step", f"horizons of {HORIZONS} steps, chi2 and mean", "ratio"]
    table("CPU time of the node for a sample at 500 Hz, medians of five turns", header, rows)


TEN = (2, 3, 4, 6, 8, 12, 16, 24, 32, 40)


def fit_times(count: int = 1_000_000) -> None:
    """A fit of ten horizons over one million transitions: CPU time over that of one step, in turns."""
    rng = np.random.default_rng(0)
    n, m, dt = 5, 4, 0.0025
    A = np.diag([-1.6, -2.0, -14.0, -15.0, -15.0]) + 0.5 * rng.normal(size=(n, n))
    B, x = rng.normal(size=(n, m)), np.zeros((count + 1, n))
    u = 0.1 * rng.normal(size=(count // 40 + 1, m)).repeat(40, axis=0)[:count]
    pushes = dt * (u @ B.T) + 1e-3 * dt * rng.normal(size=(count, n))
    step = np.eye(n) + dt * A
    for k in range(count):
        x[k + 1] = step @ x[k] + pushes[k]
    x += 1e-4 * rng.normal(size=x.shape)
    run = Transient(np.arange(count + 1) * dt, x, np.vstack([u, u[-1:]]))
    rows = []
    for criterion in ("qp", "lp"):
        turns = []
        for _ in range(3):
            found = []
            for given in ({}, {"horizons": TEN, "widths": "constant"}, {"horizons": TEN}):
                began = time.process_time()
                fit(run, criterion, additive="noise", alarm="containment", **given)  # type: ignore[arg-type]
                found.append(time.process_time() - began)
            turns.append(found)
            print(criterion, found, file=sys.stderr, flush=True)
        one, more, chosen = np.median(np.array(turns), axis=0)
        ratio = np.median([b / a for a, b, _ in turns])
        rows.append([criterion, f"{one:.2f} s", f"{more:.1f} s", f"{ratio:.1f}", f"{chosen:.1f} s"])
    table(
        f"CPU time of a fit, {count:,} transitions, n = 5, m = 4",
        ["criterion", "one step", "ten horizons, constant widths", "ratio", "widths chosen"],
        rows,
    )


CLAIMS = {"bags": bags, "live": live, "node": node, "fit": fit_times}


def main() -> None:
    """Run the claims that are named."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("claims", nargs="+", choices=[*CLAIMS, "all"])
    options = parser.parse_args()
    for claim in CLAIMS if "all" in options.claims else options.claims:
        CLAIMS[claim]()


if __name__ == "__main__":
    main()
