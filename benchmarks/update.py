# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Updates of models against the fit of all recordings: how many are proven, and how far their objective is from it.

python benchmarks/update.py            # the engine, random plants, and real robots if they are there
python benchmarks/update.py plants     # those alone

Of each machine some recordings, drawn at random and in any order, are fitted, and updated with one or two others.
"""

import sys

import numpy as np
from large import plant
from measure import table
from shared_recordings import DATA, airborne, read_shared

from uncertain_lti import fit
from uncertain_lti.base.errors import FitError
from uncertain_lti.validation.left_out import cut


def pieces(run, count=4):
    """A recording in pieces that follow each other."""
    edges = np.linspace(0, len(run) - 1, count + 1).astype(int).tolist()
    return [cut(run, a, b + 1) for a, b in zip(edges[:-1], edges[1:], strict=True)]


def turbofan():
    files = (f"bags/turbofan_{kind}.mcap" for kind in ("pulses_up_large", "pulses_down_large", "levels", "check"))
    yield [piece for run in read_shared("turbofan", *files) for piece in pieces(run)]


def plants():
    for seed in range(8):
        for n, m in ((2, 1), (4, 2), (8, 3)):
            yield pieces(plant(n, m, 40_000, seed), 5)


def go2():
    yield pieces(read_shared("go2", "go2/test_3.mcap")[0], 8)


def crazypad():
    flights = sorted(f"crazypad/{path.name}" for path in (DATA / "crazypad").glob("normal_flight*.mcap"))
    yield [piece for several in airborne(flights).values() for piece in several]


def main():
    """A row for each machine and criterion."""
    rows = []
    known = {"turbofan": turbofan, "plants": plants}
    known |= {"crazypad": crazypad, "go2": go2} if DATA.is_dir() else {}
    for name in sys.argv[1:] or known:
        for criterion, number in (("qp", "(10)"), ("lp", "(11)")):
            options, apart, refused = {"additive": "noise", "alarm": "containment"}, [], 0
            rng = np.random.default_rng(0)
            for runs in known[name]():
                for k in range(max(len(runs) // 3, 1), len(runs)):
                    order = rng.permutation(len(runs))[: k + int(rng.integers(1, 3))]
                    some, more = ([runs[i] for i in part] for part in np.split(order, [k]))
                    try:
                        model = fit(some, criterion, **options).update(more)
                    except FitError:
                        refused += 1
                        continue
                    whole = fit(some + more, criterion, **options).fit_summary["objective"]
                    apart.append(np.abs(np.divide(model.fit_summary["objective"], whole) - 1.0).max())
            rows.append([name, number, str(len(apart)), str(refused), f"{max(apart, default=0.0):.0e}"])
    table("updates", ["machine", "criterion", "proven", "refused", "objective apart"], rows)


if __name__ == "__main__":
    main()
