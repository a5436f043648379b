# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Our fits compared with their peers, on the same data in one run: widths, coverage of fresh recordings, time.

    ./run python benchmarks/comparison.py [--quick] [--only WORDS] [--peers PYTHON] [--write FILE]

PyIPM and MAPIE are asked from the interpreter --peers (default: .venv-peers/bin/python); make one with
`python3 -m venv .venv-peers && .venv-peers/bin/pip install PyIPM mapie`. Without it they are left out, which is said.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from scipy.linalg import expm
from scipy.optimize import linprog

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "tests"))
if not any("uncertain_lti" in str(p) for p in sys.path):
    sys.path.insert(0, str(ROOT / "tests" / "checkout"))

from tanks import Tanks  # noqa: E402

from uncertain_lti import OperatingPoint, Transient, fit, read_transients  # noqa: E402
from uncertain_lti.base.errors import FitError  # noqa: E402
from uncertain_lti.validation.blocks import cut  # noqa: E402

Array = np.ndarray


@dataclass(frozen=True)
class Case:
    """Recordings to fit, and fresh ones of the same plant."""

    plant: str
    train: list[Transient]
    fresh: list[Transient]
    point: OperatingPoint


@dataclass(frozen=True)
class Samples:
    """Transitions of some transients, normalised; group: which transient each comes from."""

    x: Array
    u: Array
    dt: Array
    x_next: Array
    group: Array

    @property
    def z(self) -> Array:
        """[x u], (K, p)."""
        return np.hstack([self.x, self.u])

    @classmethod
    def of(cls, transients: Sequence[Transient], point: OperatingPoint) -> Samples:
        """The usable transitions of some transients."""
        steps = [t.transitions() for t in transients]
        return cls(
            np.vstack([point.normalise_x(s.x) for s in steps]),
            np.vstack([point.normalise_u(s.u) for s in steps]),
            np.concatenate([s.dt for s in steps]),
            np.vstack([point.normalise_x(s.x_next) for s in steps]),
            np.repeat(np.arange(len(steps)), [len(s.k) for s in steps]),
        )


Bounds = tuple[Array, Array]


@dataclass(frozen=True)
class Result:
    """Bounds of the next sample on the training and on the fresh samples."""

    train: Bounds
    fresh: Bounds
    seconds: float
    promised: Array | None = None
    extra: dict[str, object] = field(default_factory=dict)


Method = Callable[[Case, Samples, Samples], Result]


def ours(criterion: str, chosen: str) -> Method:
    def run(case: Case, train: Samples, fresh: Samples) -> Result:
        fit(case.train, criterion, additive=chosen, operating_point=case.point)  # load the solvers before timing
        began = time.perf_counter()
        model = fit(case.train, criterion, additive=chosen, operating_point=case.point)
        seconds = time.perf_counter() - began
        return Result(
            model.bounds(train.x, train.u, train.dt),
            model.bounds(fresh.x, fresh.u, fresh.dt),
            seconds,
            extra={"model": model},
        )

    return run


def box(nominal: str) -> Method:
    """A constant band around least squares, or around the nominal model of least largest residual."""

    def run(case: Case, train: Samples, fresh: Samples) -> Result:
        began = time.perf_counter()
        phi = np.column_stack([train.z * train.dt[:, None], train.dt])
        step = train.x_next - train.x
        if nominal == "least squares":
            theta = np.linalg.lstsq(phi, step, rcond=None)[0]
        else:
            scale = np.abs(phi).max(axis=0)
            scale[scale == 0] = 1.0
            unit, ones = phi / scale, -np.ones((len(phi), 1))
            rows = []
            for y in step.T:
                size = max(np.abs(y).max(), 1e-300)
                answer = linprog(
                    np.append(np.zeros(phi.shape[1]), 1.0),
                    np.vstack([np.hstack([unit, ones]), np.hstack([-unit, ones])]),
                    np.concatenate([y, -y]) / size,
                    bounds=(None, None),
                    method="highs",
                )
                rows.append(answer.x[:-1] / scale * size)
            theta = np.column_stack(rows)
        half = np.abs(step - phi @ theta).max(axis=0)
        seconds = time.perf_counter() - began

        def bounds(s: Samples) -> Bounds:
            centre = s.x + np.column_stack([s.z * s.dt[:, None], s.dt]) @ theta
            return centre - half, centre + half

        return Result(bounds(train), bounds(fresh), seconds)

    return run


def peer(name: str, python: str) -> Method:
    def run(case: Case, train: Samples, fresh: Samples) -> Result:
        with tempfile.TemporaryDirectory() as folder:
            source, target = Path(folder) / "in.npz", Path(folder) / "out.npz"
            rate = (train.x_next - train.x) / train.dt[:, None]
            unit = np.maximum(np.abs(rate).max(axis=0), 1e-300)  # PyIPM fails on rates far from one
            group = train.group if train.group[-1] > 0 else np.arange(len(train.dt)) * 20 // len(train.dt)
            np.savez(source, Z=train.z, Y=rate / unit, group=group, fresh_Z=fresh.z)
            command = [python, str(Path(__file__).with_name("peers.py")), name, str(source), str(target)]
            done = subprocess.run(command, capture_output=True, text=True)
            if done.returncode:
                raise FitError(done.stderr.strip().splitlines()[-1])
            found = dict(np.load(target))

        def bounds(s: Samples, where: str) -> Bounds:
            dt = s.dt[:, None]
            return s.x + dt * unit * found[f"{where}_lower"], s.x + dt * unit * found[f"{where}_upper"]

        # containment as the peer itself computes it: its own numbers, strictly
        own = ~((found["Z_lower"] <= rate / unit) & (rate / unit <= found["Z_upper"]))
        return Result(
            bounds(train, "Z"),
            bounds(fresh, "fresh_Z"),
            float(found["seconds"]),
            found["promised"],
            {"outside": int(own.any(axis=1).sum())},
        )

    return run


@dataclass
class Row:
    """What a method did, averaged over seeds."""

    mean: list[Array] = field(default_factory=list)
    largest: list[Array] = field(default_factory=list)
    outside: list[int] = field(default_factory=list)
    samples: list[float] = field(default_factory=list)
    worst: list[float] = field(default_factory=list)
    whole: list[float] = field(default_factory=list)
    seconds: list[float] = field(default_factory=list)
    promised: list[float] = field(default_factory=list)
    failed: str = ""

    def add(self, result: Result, case: Case, train: Samples, fresh: Samples) -> None:
        """Count one result."""
        width = (result.train[1] - result.train[0]) * case.point.X
        self.mean.append(width.mean(axis=0))
        self.largest.append(width.max(axis=0))
        left = ~((result.train[0] <= train.x_next) & (train.x_next <= result.train[1]))
        self.outside.append(int(result.extra.get("outside", left.any(axis=1).sum())))  # type: ignore[call-overload]
        inside = (result.fresh[0] <= fresh.x_next) & (fresh.x_next <= result.fresh[1])
        whole = inside.all(axis=1)
        self.samples.append(float(whole.mean()))
        self.worst.append(float(inside.mean(axis=0).min()))
        self.whole.append(float(np.mean([whole[fresh.group == g].all() for g in np.unique(fresh.group)])))
        self.seconds.append(result.seconds)
        if result.promised is not None:
            self.promised.append(float(result.promised.min()))

    def cells(self) -> list[str]:
        """The row of the table, without the method's name."""
        if not self.mean:
            return [self.failed or "failed", *[""] * 7]
        numbers = [" ".join(f"{v:.3g}" for v in np.mean(values, axis=0)) for values in (self.mean, self.largest)]
        return [
            *numbers,
            f"{np.mean(self.outside):.3g}",
            f"{np.mean(self.samples):.4f}",
            f"{np.mean(self.worst):.4f}",
            f"{np.mean(self.promised):.4f}" if self.promised else "",
            f"{np.mean(self.whole):.2f}",
            f"{1e3 * np.mean(self.seconds):.3g}",
        ]


HEADER = (
    "method", "mean width", "largest width", "training outside", "fresh samples inside", "worst row", "promised",
    "whole fresh recordings inside", "fit [ms]",
)  # fmt: skip


def table(title: str, note: str, rows: dict[str, Row]) -> str:
    lines = [f"### {title}", "", note, "", "| " + " | ".join(HEADER) + " |", "|" + "---|" * len(HEADER)]
    lines += ["| " + " | ".join([name, *row.cells()]) + " |" for name, row in rows.items()]
    return "\n".join(lines) + "\n"


# --- the plants ---


def tanks(count: int, noise: float, fresh: int) -> Callable[[int], Case]:
    def make(seed: int) -> Case:
        plant = Tanks()
        return Case(
            "tanks",
            plant.transients(count, seed, noise=noise),
            plant.transients(fresh, 10_000 + seed, noise=noise),
            OperatingPoint.identity(3, 1),
        )

    return make


R, C, L, DT = 3.0, 270e-9, 50e-6, 5e-7


def rlc_matrices() -> tuple[Array, Array, Array]:
    """[V_C / 100 V, I_L / 10 A] under V_IN / 100 V: continuous A; A, B of one exact step as forward Euler sees it."""
    A = np.array([[0.0, 0.1 / C], [-10.0 / L, -R / L]])
    B = np.array([[0.0], [10.0 / L]])
    exact = expm(np.block([[A, B], [np.zeros((1, 3))]]) * DT)
    return A, (exact[:2, :2] - np.eye(2)) / DT, exact[:2, 2:] / DT


def rlc(noise: float, fresh: int) -> Callable[[int], Case]:
    """The circuit of the public RLC recordings under random input steps, exact between samples, with noisy readings."""
    _, A, B = rlc_matrices()

    def runs(count: int, seed: int) -> list[Transient]:
        rng = np.random.default_rng(seed)
        found = []
        for i in range(count):
            u = np.repeat(rng.uniform(-1, 1, 6), 40)[:201, None]
            x = np.zeros((201, 2))
            x[0] = rng.uniform(-0.5, 0.5, 2)
            for k in range(200):
                x[k + 1] = x[k] + DT * (A @ x[k] + B @ u[k])
            x = x + noise * rng.standard_normal(x.shape)
            found.append(Transient(np.arange(201) * 500, x, u, name=f"rlc {seed}.{i}"))
        return found

    return lambda seed: Case("rlc", runs(20, seed), runs(fresh, 10_000 + seed), OperatingPoint.identity(2, 1))


def turbofan(seed: int) -> Case:
    from uncertain_lti.plants.turbofan_runs import RECORDINGS, make_run, simulate

    def runs(names: Sequence[str], first: int) -> list[Transient]:
        return [
            simulate(make_run(**{**RECORDINGS[name], "noise": 1e-4, "seed": first + i}))  # type: ignore[arg-type]
            for i, name in enumerate(names)
        ]

    train = runs(["turbofan_pulses_up_large", "turbofan_pulses_down_large"] * 2, 100 * seed)
    fresh = runs(["turbofan_check"] * 5 + ["turbofan_levels"] * 2, 100 * seed + 50)
    signals = train[0].signals
    assert signals is not None
    return Case("turbofan", train, fresh, OperatingPoint.of(signals.states, signals.controls))


def real(name: str, train: Sequence[str], fresh: Sequence[str], signals: str) -> Callable[[int], Case]:
    data = ROOT.parent / "shared" / "data"

    def make(seed: int) -> Case:
        if not data.is_dir():
            raise FileNotFoundError("the real recordings (../shared/data) are not here")
        bags = [data / f"{bag}.mcap" for bag in (*train, *fresh)]
        read = read_transients(bags, ROOT / "config" / "signals" / f"{signals}.yaml")
        first = read[0]
        assert first.signals is not None
        point = OperatingPoint.of(first.signals.states, first.signals.controls)
        if fresh:
            return Case(name, read[: len(train)], read[len(train) :], point)
        edges = range(0, len(first) - 500, 500)  # every other stretch of 500 samples of one recording
        parts = [cut(first, a, a + 500) for a in edges]
        parts = [p for p in parts if p.usable.sum() > 100]
        return Case(name, parts[::2], parts[1::2], point)

    return make


def cases(quick: bool) -> Iterator[tuple[str, str, Callable[[int], Case], int]]:
    fresh, seeds = (100, 1) if quick else (300, 5)
    words = f"{fresh} fresh transients of 100 steps, {seeds} seed{'s' if seeds > 1 else ''}; three rows"
    for count in (5, 20) if quick else (5, 20, 50):
        yield f"Three tanks, {count} transients, no noise", words, tanks(count, 0.0, fresh), seeds
    yield "Three tanks, 20 transients, noise 1e-3", words, tanks(20, 1e-3, fresh), seeds
    yield (
        "RLC circuit (linear), 20 transients, noise 1e-3",
        f"{fresh} fresh transients of 200 steps; V_C / 100 V and I_L / 10 A",
        rlc(1e-3, fresh),
        seeds,
    )
    yield (
        "Turbofan, pulses of both signs, noise 1e-4",
        "five states; fresh: the closed-loop check five times and the run along levels twice, each with its own noise; "
        "recorded units",
        turbofan,
        1,
    )
    yield (
        "Unitree Go2, joint 0",
        "every other second fitted, the others fresh; rad and rad/s",
        real("go2", ["go2/test_3"], [], "go2_joint"),
        1,
    )
    yield (
        "Micro gas turbine",
        "fitted on ex_1 and ex_20 (steps), fresh: ex_24 (ramps); W",
        real(
            "gas turbine",
            ["micro_gas_turbine/ex_1", "micro_gas_turbine/ex_20"],
            ["micro_gas_turbine/ex_24"],
            "micro_gas_turbine",
        ),
        1,
    )
    straight = "hunter_se/straight_"
    yield (
        "Hunter SE",
        "fitted on one run at throttle 0.5, fresh: its repeat and a run at throttle 0.2; m/s",
        real(
            "hunter",
            [f"{straight}odd_t_0_5_run_01"],
            [f"{straight}odd_t_0_5_run_02", f"{straight}even_t_0_2_run_01"],
            "hunter_se",
        ),  # fmt: skip
        1,
    )
    yield (
        "Crazyflie, Vicon",
        "fitted on rollbag, fresh: yx3 (with a drop-out) and yx4; rad",
        real("crazyflie", ["crazyflie/rollbag_0"], ["crazyflie/yx3bag_0", "crazyflie/yx4bag_0"], "crazyflie_vicon"),
        1,
    )


def truth_inside(model: object) -> str:
    """Whether the matrices of the circuit lie inside the fitted intervals."""
    _, A, B = rlc_matrices()
    inside = np.hstack([np.abs(model.A - A) <= model.dA, np.abs(model.B - B) <= model.dB])  # type: ignore[attr-defined]
    return f"{int(inside.sum())} of {inside.size} elements"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="one seed, fewer fresh transients")
    parser.add_argument("--only", metavar="WORDS", default="", help="only the plants whose title holds these words")
    parser.add_argument("--peers", default=str(ROOT / ".venv-peers" / "bin" / "python"), help="with PyIPM and mapie")
    parser.add_argument("--write", metavar="FILE", help="write the tables to this file")
    options = parser.parse_args()
    methods: dict[str, Method] = {
        "(10), pure intervals": ours("qp", "none"),
        "(10), noise": ours("qp", "noise"),
        "(10), drift and noise": ours("qp", "both"),
        "(11), pure intervals": ours("lp", "none"),
        "(11), noise": ours("lp", "noise"),
        "(11), drift and noise": ours("lp", "both"),
        "box around least squares": box("least squares"),
        "box around minimax": box("minimax"),
    }
    said = []
    for name, module in (("PyIPM", "PyIPM"), ("MAPIE", "mapie")):
        if (
            not Path(options.peers).exists()
            or subprocess.run([options.peers, "-c", f"import {module}"], capture_output=True).returncode
        ):
            said.append(f"{name} is not compared: it is not installed for {options.peers} (see --help).")
        else:
            methods[name if name == "PyIPM" else "MAPIE split conformal, 99 %"] = peer(name, options.peers)
    texts = [*said]
    for title, note, make, seeds in cases(options.quick):
        if options.only not in title:
            continue
        rows = {name: Row() for name in methods}
        truth: dict[str, str] = {}
        try:
            for seed in range(seeds):
                case = make(seed)
                train, fresh = Samples.of(case.train, case.point), Samples.of(case.fresh, case.point)
                for name, method in methods.items():
                    try:
                        result = method(case, train, fresh)
                    except FitError as error:
                        known = "infeasible: a sample at rest has a moving successor"
                        rows[name].failed = known if "at rest" in str(error) else f"failed: {error}"[:150]
                        continue
                    rows[name].add(result, case, train, fresh)
                    if case.plant == "rlc" and "model" in result.extra:
                        truth[name] = truth_inside(result.extra["model"])
        except (FileNotFoundError, ImportError) as error:
            texts.append(f"### {title}\n\nLeft out: {error}.\n")
            continue
        note = f"{len(case.train)} recordings, {len(train.dt)} transitions to fit; {note}."
        if truth:
            note += " The true one-step matrices lie inside the fitted intervals in "
            note += "; ".join(f"{value} by {name}" for name, value in truth.items())
            note += " (containing samples is not containing parameters: where the noise term takes the width, hardly "
            note += "any is left for the matrices, and their error is that of any estimate)."
        text = table(title, note, rows)
        print(text, flush=True)
        texts.append(text)
    if options.write:
        Path(options.write).write_text("\n".join(texts))
    for sentence in said:
        print(sentence)


if __name__ == "__main__":
    main()
