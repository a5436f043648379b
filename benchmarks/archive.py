# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""A fit over 64 bags on a local Dask cluster of two workers, and from a cache on disk: the same model as in memory.

python benchmarks/archive.py            # 64 bags of 5000 samples
python benchmarks/archive.py --quick    # of 500

Prints the time of each way, how far its matrices and its objective are from those of one process that holds everything
in memory, and training transitions outside. In one of the runs a worker is killed while the fit is under way.
"""

from __future__ import annotations

import argparse
import os
import platform
import signal
import tempfile
import threading
from pathlib import Path

import numpy as np
from measure import best, table
from recorded import JAZZY, Topic, message, write

from uncertain_lti import read_transients
from uncertain_lti.identification import fit
from uncertain_lti.identification.archive import fit_archive
from uncertain_lti.plants.leibov import leibov2006
from uncertain_lti.signals.signal_map import Signal, SignalMap

BAGS = 64
DT_NS = 25_000_000
SIGNALS = SignalMap(
    tuple(Signal(f"x{i}", "/state", f"position[{i}]") for i in range(5)),
    tuple(Signal(f"u{j}", "/control", f"data[{j}]") for j in range(4)),
)


def runs(samples):
    """States (bags, samples, 5) and controls (bags, samples, 4) of the published matrices, drawn at each step."""
    rng = np.random.default_rng(0)
    plant = leibov2006()
    nominal, spread = np.hstack([plant.A, plant.B]), np.hstack([plant.dA, plant.dB])
    u = np.repeat(rng.uniform(-1, 1, (BAGS, samples // 20 + 1, 4)), 20, axis=1)[:, :samples]
    x = np.zeros((BAGS, samples, 5))
    x[:, 0] = rng.uniform(-1, 1, (BAGS, 5))
    for k in range(samples - 1):
        z = np.hstack([x[:, k], u[:, k]])
        drawn = nominal + spread * rng.uniform(-1, 1, (BAGS, *nominal.shape))
        x[:, k + 1] = x[:, k] + 1e-9 * DT_NS * np.einsum("bij,bj->bi", drawn, z)
    return x, u


def bags(folder, samples):
    """The runs as recordings."""
    header = message("std_msgs/msg/Header", stamp=message("builtin_interfaces/msg/Time", sec=0, nanosec=0), frame_id="")
    layout = message("std_msgs/msg/MultiArrayLayout", dim=[], data_offset=0)
    kinds = "sensor_msgs/msg/JointState", "std_msgs/msg/Float64MultiArray"
    topics = [Topic("/state", kinds[0]), Topic("/control", kinds[1])]
    empty = np.empty(0)
    paths = []
    for number, (x, u) in enumerate(zip(*runs(samples), strict=True)):
        states = [message(kinds[0], header=header, name=[], position=v, velocity=empty, effort=empty) for v in x]
        controls = [message(kinds[1], layout=layout, data=v) for v in u]
        encoded = [
            [bytes(JAZZY.serialize_cdr(m, kind)) for m in several]
            for kind, several in zip(kinds, (states, controls), strict=True)
        ]
        # each control is logged before the state of its instant, a step of DT apart
        name = folder / f"run{number:02}x.mcap"
        paths.append(write(name, topics[::-1], encoded[::-1], step_ns=DT_NS))
    return paths


def killing(cluster):
    """Progress that kills a worker at the first pass, one of those that run then: one killed before starts again."""
    killed = threading.Event()

    def say(line):
        if line.startswith("pass ") and not killed.is_set():
            processes = [worker.process.process for worker in cluster.workers.values() if worker.process is not None]
            os.kill(next(p.pid for p in processes if p is not None and p.is_alive()), signal.SIGKILL)
            killed.set()

    return say, killed


def main():
    """All ways, one after the other."""
    import logging

    from distributed import Client, LocalCluster

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="a tenth of the size")
    samples = 500 if parser.parse_args().quick else 5000
    print(f"{os.cpu_count()} cores, Python {platform.python_version()}, numpy {np.__version__}")
    rows = []
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        paths = bags(folder, samples)

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
        reading, transients = best(lambda: read_transients(paths, SIGNALS), 1)
        for criterion in ("qp", "lp"):
            took, models[criterion] = best(lambda c=criterion: fit(transients, c), 1)
            row("in memory", criterion, reading + took, models[criterion])
            cache = folder / f"cache_{criterion}"
            row("cache", criterion, *best(lambda c=criterion, f=cache: fit_archive(paths, SIGNALS, c, cache=f), 1))
        local = dict(n_workers=2, threads_per_worker=1, host="127.0.0.1", dashboard_address=None)
        local["silence_logs"] = logging.CRITICAL  # of the worker that is killed
        with LocalCluster(**local) as cluster, Client(cluster) as client:
            for criterion in ("qp", "lp"):
                row(
                    "two workers",
                    criterion,
                    *best(lambda c=criterion: fit_archive(paths, SIGNALS, c, client=client), 1),
                )
            for criterion in ("qp", "lp"):
                say, killed = killing(cluster)
                took, model = best(
                    lambda c=criterion, s=say: fit_archive(paths, SIGNALS, c, client=client, progress=s), 1
                )
                assert killed.is_set()
                row("two workers, one killed", criterion, took, model)
    header = ["way", "criterion", "reading and fit", "elements differ", "objective differs", "outside"]
    table(f"{BAGS} bags, {sum(t.transitions().k.size for t in transients)} transitions, n = 5, m = 4", header, rows)
    if failed:
        raise SystemExit(f"not the same model to 1e-9, nor objective to 1e-12: {'; '.join(failed)}")


if __name__ == "__main__":
    main()
