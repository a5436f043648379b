# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Frozen inputs: how soon a held state of real recordings is reported, and what healthy recordings raise.

    ./run python benchmarks/frozen.py                    # the table of docs/real_machines.md (Markdown)
    ./run python benchmarks/frozen.py --data FOLDER --seed 7
    ./run python benchmarks/frozen.py --healthy          # each recording left out in turn: what is called frozen there
    ./run python benchmarks/frozen.py --horizons         # would a repeat be told sooner by bounds over several steps?

Each machine is fitted to some recordings, or every other second of one, and 200 instants of the others, drawn at
random, hold one state from there on. Instants count at which the machine moves: within one second (or one sample, if
that is later) the true value leaves the held one by more than the half-width of its bounds. The recordings are public
and not part of this repository. Without them the exit status is 2.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from measure import table
from numpy.typing import NDArray
from real_machines import CASES, Case
from shared_recordings import DATA, crazypad_labels, read_shared, signals_of

from uncertain_lti import EnvelopeMonitor, Transient, UncertainLTI, fit
from uncertain_lti.sampling.reading import read_as_fitted
from uncertain_lti.validation.blocks import cut

INSTANTS, WITHIN, SECONDS = 200, 1.0, 2.0
OTHER_WAY = Case(
    "Neato, 5 Hz, the other way round", "neato", ["neato/draw_square.mcap"], ["neato/person_follower.mcap"]
)


def of_case(data: Path, case: Case) -> tuple[list[Transient], list[Transient]]:
    """Recordings that are fitted, and others."""
    first = read_shared(case.signals, *case.fitted, data=data)
    assert first[0].signals is not None
    return first, [read_as_fitted(data / name, first[0].signals) for name in case.checked]


def of_joint(data: Path, joint: int) -> tuple[list[Transient], list[Transient], list[Transient]]:
    """One joint of the quadruped: every other second is fitted; any instant of the run is held."""
    text = signals_of("go2_joint").replace("[j0]", f"[j{joint}]")
    (whole,) = read_shared("go2_joint", "go2/test_3.mcap", data=data, text=text)
    seconds = [cut(whole, start, start + 500) for start in range(0, 6500, 500)]
    return seconds[::2], seconds[1::2], [cut(whole, 0, 6500)]


def held(transient: Transient, state: int, begin: int) -> Transient:
    """Two seconds in which the state keeps the value of this sample, and some samples before."""
    last = max(int(np.searchsorted(transient.t_ns, transient.t_ns[begin] + round(SECONDS * 1e9))), begin + 12)
    part = slice(max(0, begin - 5), min(last, len(transient)))
    x = transient.x[part].copy()
    x[begin - part.start + 1 :, state] = x[begin - part.start, state]
    return Transient(transient.t_ns[part], x, transient.u[part], signals=transient.signals, max_gap=transient.max_gap)


def leaves(model: UncertainLTI, transient: Transient, state: int, begin: int) -> float:
    """After how many seconds, of one, the true value leaves the held one by more than the half-width; else infinite."""
    end = int(np.searchsorted(transient.t_ns, transient.t_ns[begin] + round(WITHIN * 1e9), side="right"))
    end = max(end, begin + 2)
    point = model.operating_point
    x, u = point.normalise_x(transient.x[begin:end]), point.normalise_u(transient.u[begin:end])
    if len(x) < 2 or not np.isfinite(x[0, state]):
        return math.inf
    _, half = model.centre_and_half(x, u, model.sampling.dt_median or 0.0)
    away = np.flatnonzero(np.abs(x[:, state] - x[0, state]) > np.nanmedian(half[:, state]))
    return float(transient.t[begin + away[0]] - transient.t[begin]) if len(away) else math.inf


def measure(
    name: str,
    fitted: Sequence[Transient],
    others: Sequence[Transient],
    sources: Sequence[Transient] = (),
    seed: int = 0,
) -> list[list[str]]:
    """One row per state; what is held is taken from the sources, where given, else from the others."""
    sources = sources or others
    model = fit(fitted)
    monitor = EnvelopeMonitor(model)
    healthy = [monitor.check(t) for t in others]
    hours = sum(float(np.diff(t.t_ns).sum()) for t in others) * 1e-9 / 3600
    rows = []
    assert model.repeats is not None
    for state, signal in enumerate(model.signals.states):
        rng = np.random.default_rng(seed + state)
        delays, within, after, drawn = list[float](), list[bool](), list[bool](), 0
        for _ in range(50 * INSTANTS):
            transient = sources[rng.integers(len(sources))]
            usable = np.flatnonzero(transient.usable)
            begin, drawn = int(rng.choice(usable)) if len(usable) else 0, drawn + 1
            if not len(usable) or not math.isfinite(left := leaves(model, transient, state, begin)):
                continue
            part = held(transient, state, begin)
            start = min(begin, 5)
            told = np.flatnonzero(monitor.check(part).frozen[:, state])
            delays.append(float(part.t[told[0]] - part.t[start]) if len(told) else math.inf)
            within.append(delays[-1] <= max(WITHIN, part.t[start + 1] - part.t[start]))
            after.append(delays[-1] <= left + WITHIN)
            if len(delays) == INSTANTS:
                break
        false = sum(onsets(v.frozen[:, state]) for v in healthy)
        at = np.sort(delays) if delays else np.array([math.nan])
        rows.append(
            [
                f"{name}: {signal.name}",
                f"{model.repeats.longest_repeat_s[state]:.3g}",
                f"{len(delays)}, {len(delays) / drawn:.0%}",
                f"{np.mean(within):.0%}" if delays else "-",
                f"{np.mean(after):.0%}" if delays else "-",
                f"{at[len(at) // 2]:.2g}" if delays else "-",
                f"{at[min(len(at) - 1, math.ceil(0.9 * len(at)) - 1)]:.2g}" if delays else "-",
                f"{false} in {hours:.2g} h",
            ]
        )
    return rows


def onsets(frozen: NDArray[np.bool_]) -> int:
    """How often a state becomes frozen."""
    return int((np.diff(np.concatenate([[0], frozen.astype(int)])) == 1).sum())


def left_out(data: Path) -> list[list[str]]:
    """One row per machine: what is called frozen in each recording by the model of the others."""
    machines = {
        case.machine: read_shared(case.signals, *sorted({*case.fitted, *case.checked}), data=data) for case in CASES
    }
    flights = [file for file, label in crazypad_labels(data).items() if not label["faulty"]]
    machines["Crazyflie, CrazyPAD, 100 Hz"] = read_shared("crazypad", *flights, data=data)
    rows = []
    for joint in range(12):
        _, _, (whole,) = of_joint(data, joint)
        machines[f"Go2, 500 Hz, joint {joint}"] = [cut(whole, start, start + 1300) for start in range(0, 6500, 1300)]
    for name, recordings in machines.items():
        count, warned, seconds = 0, 0, 0.0
        for left in recordings:
            verdicts = EnvelopeMonitor(fit([t for t in recordings if t is not left])).check(left)
            count += sum(onsets(column) for column in verdicts.frozen.T)
            warned += sum(onsets(column) for column in verdicts.repeating.T)
            seconds += float(np.diff(left.t_ns).sum()) * 1e-9
        rows.append([name, str(len(recordings)), f"{seconds / 60:.3g} min", str(count), str(warned)])
    return rows


STEPS = {"hunter_se": (5, 10, 25)}
"""Horizons in steps that are looked at; of the others 2, 5 and 10."""


def horizon_widths(case: Case, data: Path) -> list[str]:
    """One row: the half-width of one step over the range of each state, and those of horizons over that of one step."""
    fitted, (checked, *_) = of_case(data, case)
    steps = STEPS.get(case.signals, (2, 5, 10))
    model, transitions = fit(fitted, horizons=list(steps)), checked.transitions()
    z, shape = model.normalised_columns(transitions), (model.n, len(transitions.dt))
    centre, half = np.empty(shape), np.empty(shape)
    model.columns_centre_and_half(z, transitions.dt, centre, half)
    one = np.median(half, axis=1)
    longer = {w.steps: np.median(h, axis=1) / one for w, _, h in model.envelopes(transitions.k, z, transitions.dt)}
    reach = one * model.operating_point.X / np.ptp(np.vstack([t.x for t in fitted]), axis=0)
    rows = [reach, *(longer.get(h, np.full(model.n, np.nan)) for h in steps)]
    return [case.machine, *(", ".join(f"{v:.2f}" for v in row) for row in rows), "/".join(map(str, steps))]


def main() -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, default=DATA, help="folder of the recordings")
    parser.add_argument("--horizons", action="store_true", help="compare half-widths over several steps with one step")
    parser.add_argument("--seed", type=int, default=0, help="of the instants; default 0")
    parser.add_argument("--healthy", action="store_true", help="what is called frozen on recordings that are left out")
    options = parser.parse_args()
    data = options.data
    if not data.is_dir():
        print(f"{data}: the recordings are not there; name their folder with --data", file=sys.stderr)
        return 2
    if options.healthy:
        table("Left out", ("machine", "recordings", "left out", "frozen", "repeats warned of"), left_out(data))
        return 0
    if options.horizons:
        slow = [c for c in (*CASES, OTHER_WAY) if not c.signals.startswith("crazyflie")]
        header = ("machine", "one step over range", "first horizon over one step", "second", "third", "steps")
        table("Half-widths over several steps, states in turn", header, [horizon_widths(c, data) for c in slow])
        return 0
    rows = []
    for joint in range(12):
        rows += measure(f"Go2, 500 Hz, joint {joint}", *of_joint(data, joint), seed=options.seed)
    for case in (*CASES, OTHER_WAY):
        rows += measure(case.machine, *of_case(data, case), seed=options.seed)
    header = (
        "machine: state",
        "longest repeat, s",
        "held, of instants",
        "within 1 s",
        "of leaving",
        "median",
        "90 %",
        "false",
    )
    table("Held states", header, rows)
    return 0


if __name__ == "__main__":
    sys.exit(main())
