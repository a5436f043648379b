# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""A fit over 64 tables on a local Dask cluster of two workers, and from a cache on disk: the same model as in memory.

python benchmarks/archive.py            # 64 tables of 5000 samples
python benchmarks/archive.py --quick    # of 500
python benchmarks/archive.py --wide     # 20 tables of 100 000 samples of 50 states, on one, two and four workers
python benchmarks/archive.py --long     # 100 tables of 10^6 samples, 4.5 GB on disk and 12 GB of cache: time and memory

Prints the time of each way, how far its matrices and its objective are from those of one process that holds everything
in memory, and training transitions outside. In one of the runs a worker is killed while the fit is under way.
"""

from __future__ import annotations

import argparse
import logging
import os
import platform
import signal
import tempfile
import threading
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from distributed import Client, LocalCluster
from measure import best, peak_memory, table

from uncertain_lti import read_transients
from uncertain_lti.identification import fit
from uncertain_lti.identification.archive import fit_archive
from uncertain_lti.identification.fleet import DaskFleet
from uncertain_lti.proposal.public_fit import fit_many
from uncertain_lti.signals.signal_map import Signal, SignalMap

COUNT = 64
LOCAL = dict(threads_per_worker=1, host="127.0.0.1", dashboard_address=None)
LOCAL["silence_logs"] = logging.CRITICAL  # of the worker that is killed
DT_NS = 25_000_000


def tables(folder, count, samples, n, m, seed=0):
    """Tables of a machine of n states, every column a signal, and these signals."""
    rng = np.random.default_rng(0)
    A, B = 0.1 * rng.normal(size=(n, n)) - 2.0 * np.eye(n), rng.normal(size=(n, m))
    names = [*(f"x{i}" for i in range(n)), *(f"u{j}" for j in range(m))]
    rng = np.random.default_rng(seed)
    u = rng.uniform(-1, 1, (count, samples // 20 + 1, m)).repeat(20, axis=1)[:, :samples]
    x = rng.uniform(-1, 1, (samples, count, n))
    for k in range(samples - 1):
        x[k + 1] = x[k] + 1e-9 * DT_NS * (x[k] @ A.T + u[:, k] @ B.T + 1e-2 * rng.normal(size=(count, n)))
    for number in range(count):
        columns = {"t [s]": 1e-9 * DT_NS * np.arange(samples)}
        columns |= dict(zip(names, np.hstack([x[:, number], u[number]]).T, strict=True))
        pq.write_table(pa.table(columns), folder / f"run{seed + number:02}.parquet")
    states, controls = (tuple(Signal(name, "/table", name) for name in some) for some in (names[:n], names[n:]))
    return sorted(folder.glob("run*.parquet")), SignalMap(states, controls)


def killing(cluster):
    """Progress that kills a worker at the first pass, one of those that run then: one killed before starts again."""
    killed = threading.Event()

    def say(line):
        if line.startswith("pass ") and not killed.is_set():
            processes = [worker.process.process for worker in cluster.workers.values() if worker.process is not None]
            os.kill(next(p.pid for p in processes if p is not None and p.is_alive()), signal.SIGKILL)
            killed.set()

    return say, killed


def wide(count=20, samples=100_000):
    """A fit on one, two and four workers: time, and what goes to them and comes back."""
    from cloudpickle import dumps

    rows, run, moved = [], DaskFleet.run, [0, 0]

    def counted(client, tasks, done=None):
        results = run(client, tasks, done)
        moved[0] += sum(len(dumps(task)) for task in tasks)
        moved[1] += sum(len(dumps(result)) for result in results)
        return results

    DaskFleet.run = staticmethod(counted)
    with tempfile.TemporaryDirectory() as temporary:
        paths, signals = tables(Path(temporary), count, samples, 50, 10)
        cache = Path(temporary) / "cache"
        took, _ = best(lambda: fit_archive(paths, signals, "qp", "noise", cache=cache), 1)
        rows.append(["one process, from disk", f"{took:.0f} s", "1", "", ""])
        for workers in (1, 2, 4):
            moved[:] = 0, 0
            with LocalCluster(n_workers=workers, **LOCAL) as cluster, Client(cluster) as client:
                last, _ = best(lambda c=client: fit_archive(paths, signals, "qp", "noise", client=c), 1)
            rows.append(
                [f"{workers} workers", f"{last:.0f} s", f"{took / last:.2f}", *(f"{b / 1e6:.0f} MB" for b in moved)]
            )
    header = ["way", "reading and fit", "speed", "sent", "brought back"]
    table(f"{count} tables, {count * (samples - 1)} transitions, n = 50, m = 10, (10) with noise", header, rows)


def long(count=100, samples=1_000_000):
    """The public call with more than memory is for."""
    with tempfile.TemporaryDirectory() as temporary:
        for seed in range(0, count, 5):
            paths, signals = tables(Path(temporary), 5, samples, 5, 4, seed)
        Path("/proc/self/clear_refs").write_text("5")  # the peak counts from here on
        took, model = best(lambda: fit_many(paths, signals, cache=f"{temporary}/cache"), 1)
        row = [f"{took:.0f} s", f"{peak_memory() / 2**20:.0f} MiB", f"{model.fit_summary['optimality_gap']:.0e}"]
        table(f"{count} tables, {count * (samples - 1)} transitions", ["took", "peak memory", "gap"], [row])


def main():
    """All ways, one after the other."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="a tenth of the size")
    parser.add_argument("--wide", action="store_true", help="many states, on more and more workers")
    parser.add_argument("--long", action="store_true", help="10^8 transitions")
    options = parser.parse_args()
    print(f"{os.cpu_count()} cores, Python {platform.python_version()}, numpy {np.__version__}")
    if options.wide or options.long:
        return wide() if options.wide else long()
    rows = []
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        paths, signals = tables(folder, COUNT, 500 if options.quick else 5000, 5, 4)

        def row(name, criterion, took, model):
            known = models[criterion]
            elements = max(np.abs(getattr(model, a) - getattr(known, a)).max() for a in ("A", "B", "dA", "dB"))
            objective = np.max(np.abs(np.divide(model.fit_summary["objective"], known.fit_summary["objective"]) - 1))
            outside = 0
            for transient in transients:
                s = transient.transitions()
                lower, upper = model.bounds(s.x, s.u, s.dt)
                outside += int((~((lower <= s.x_next) & (s.x_next <= upper))).any(axis=1).sum())
            good = elements <= 1e-9 and objective <= 1e-12 and outside == 0
            failed.extend([] if good else [f"{name}, {criterion}"])
            rows.append([name, criterion, f"{took:.1f} s", f"{elements:.0e}", f"{objective:.0e}", str(outside)])

        models, failed = {}, []
        reading, transients = best(lambda: read_transients(paths, signals), 1)
        for criterion in ("qp", "lp"):
            took, models[criterion] = best(lambda c=criterion: fit(transients, c), 1)
            row("in memory", criterion, reading + took, models[criterion])
            given = {"cache": folder / f"cache_{criterion}"}
            row("cache", criterion, *best(lambda c=criterion, g=given: fit_archive(paths, signals, c, **g), 1))
        with LocalCluster(n_workers=2, **LOCAL) as cluster, Client(cluster) as client:
            for criterion in ("qp", "lp"):
                say, killed = killing(cluster)
                for way, given in (("two workers", {}), ("two workers, one killed", {"progress": say})):
                    given |= {"client": client}
                    row(way, criterion, *best(lambda c=criterion, g=given: fit_archive(paths, signals, c, **g), 1))
                assert killed.is_set()
    header = ["way", "criterion", "reading and fit", "elements differ", "objective differs", "outside"]
    table(f"{COUNT} tables, {sum(t.transitions().k.size for t in transients)} transitions, n = 5, m = 4", header, rows)
    if failed:
        raise SystemExit(f"not the same model to 1e-9, nor objective to 1e-12: {'; '.join(failed)}")


if __name__ == "__main__":
    main()
