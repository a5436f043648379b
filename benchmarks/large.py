# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Machines of many states: `fit()` with noise and its containment alarm against lstsq, CPU time of all threads.

OPENBLAS_NUM_THREADS=1 python benchmarks/large.py            # n = 40, m = 8, 2*10^4 transitions
OPENBLAS_NUM_THREADS=1 python benchmarks/large.py 100 20 20000
"""

import argparse
import time
from multiprocessing import get_context

import numpy as np
from measure import peak_memory, table

from uncertain_lti import Transient, fit


def plant(n, m, count, seed=0):
    """A recording of a random stable plant whose steps are disturbed within a box."""
    rng = np.random.default_rng(seed)
    dt = 0.01
    A, B = rng.normal(size=(n, n)) / np.sqrt(n) - 2 * np.eye(n), rng.normal(size=(n, m))
    x, u = np.zeros((count + 1, n)), np.zeros((count + 1, m))
    moves, noise = rng.normal(size=(count, m)), rng.uniform(-1, 1, size=(count, n))
    for k in range(count):
        u[k + 1] = 0.95 * u[k] + 0.3 * moves[k]
        x[k + 1] = x[k] + dt * (A @ x[k] + B @ u[k]) + 0.002 * noise[k]
    return Transient(np.arange(count + 1) * dt, x, u)


def seconds(function):
    """CPU and wall time of a call, and its result."""
    cpu, wall = time.process_time(), time.perf_counter()
    result = function()
    return time.process_time() - cpu, time.perf_counter() - wall, result


def measured(size, criterion, name):
    """A row of the table; the memory is the peak of the process, which is its own."""
    options = {"additive": "noise", "alarm": "containment"}
    fit(plant(4, 2, 2000), criterion, **options)  # imports
    run = plant(*size)
    cpu, wall, model = seconds(lambda: fit(run, criterion, **options))
    gap, peak = f"{model.fit_summary['optimality_gap']:.1g}", f"{peak_memory() / 2**20:.0f} MiB"  # less those of lstsq
    z, step = np.hstack([run.x, run.u])[:-1], np.diff(run.x, axis=0)
    least = min(seconds(lambda: np.linalg.lstsq(z, step, rcond=None))[0] for _ in range(3))
    return [name, f"{least:.3f} s", f"{cpu:.1f} s", f"{wall:.1f} s", f"{cpu / least:.0f}", gap, peak]


def main():
    """Print a row for (10) and one for (11)."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("size", type=int, nargs="*", default=[40, 8, 20_000], help="states, controls, transitions")
    size = parser.parse_args().size
    with get_context("spawn").Pool(1, maxtasksperchild=1) as own:
        rows = own.starmap(measured, [(size, "qp", "(10)"), (size, "lp", "(11)")], chunksize=1)
    header = ["criterion", "lstsq", "CPU", "wall", "CPU over lstsq", "gap", "peak memory"]
    table("n = {}, m = {}, {} transitions".format(*size), header, rows)


if __name__ == "__main__":
    main()
