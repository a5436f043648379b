# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""`uncertain-lti reproduce`: the numerical example of Leibov (2006), on the nonlinear turbofan of this project."""

from __future__ import annotations

import json
import os
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.linalg import expm

from uncertain_lti.base.files import whole_file
from uncertain_lti.base.progress import CountedStep
from uncertain_lti.base.text import Table, number
from uncertain_lti.identification import fit
from uncertain_lti.model.uncertain_lti import UncertainLTI
from uncertain_lti.monitor.envelope_monitor import EnvelopeMonitor
from uncertain_lti.monitor.verdict import Verdicts
from uncertain_lti.plants.leibov import leibov2006
from uncertain_lti.plants.turbofan import engine
from uncertain_lti.plants.turbofan_runs import DT, LARGE, NOISE, SMALL, make_run, operating_point, simulate, trim
from uncertain_lti.reports.figures import envelope_figure, save, utilisation_figure
from uncertain_lti.sampling.transient import Transient

SHORT = ("N1", "N2", "P3", "P5", "T5")
"""Fan and compressor speed, pressures behind compressor and turbine, temperature behind the turbine."""
SHORT_CONTROLS = ("fuel", "area", "fan vanes", "comp. vanes")


class Case(NamedTuple):
    """One identification and its check on another transient.

    `numbers`: of the fit and the check, as `reproduce.json` has them. Shares and widths are of the check's transitions,
    a value per state; widths per step, normalised; `discrepancy_4` and `discrepancy_5` of the nominal model, Leibov
    (2006), eq. (4) with W = I and (5).
    """

    model: UncertainLTI
    verdicts: Verdicts
    numbers: dict[str, Any]


def fit_and_check(name: str, transients: Sequence[Transient], check: Transient, additive: Any, criterion: Any) -> Case:
    """Fit a model and check it on another transient."""
    began = time.perf_counter()
    model = fit(transients, criterion, additive=additive)
    seconds = time.perf_counter() - began
    monitor = EnvelopeMonitor(model)
    verdicts = monitor.check(check)
    judged, steps, point = verdicts.judged, check.transitions(), model.operating_point
    ranges = replace(model.domain, measure=None)  # pulses, one control at a time, fit few combinations
    width = ((verdicts.upper - verdicts.lower) / point.X)[judged]
    squared, largest = model.discrepancy(check)
    numbers = {
        "identified_from": name,
        "criterion": criterion,
        "additive": additive,
        "objective": np.asarray(model.fit_summary["objective"]).tolist(),
        "outside_identification": sum(int(monitor.check(t).violated.sum()) for t in transients),
        "inside": (1.0 - (verdicts.flags[judged] == 1.0).mean(axis=0)).tolist(),
        "inside_all": 1.0 - float(verdicts.violated[judged].mean()),
        "mean_width": width.mean(axis=0).tolist(),
        "max_width": width.max(axis=0).tolist(),
        "discrepancy_4": squared,
        "discrepancy_5": largest.tolist(),
        "outside_domain": int(ranges.outside(point.normalise_x(steps.x), point.normalise_u(steps.u)).sum()),
        "eigenvalues": [[v.real, v.imag] for v in model.eigenvalues().tolist()],
        "seconds": seconds,
    }
    return Case(model, verdicts, numbers)


def reproduce(
    output: str | os.PathLike[str], say: Callable[[str], None] = print, progress: Callable[[str], None] | None = None
) -> dict[str, Any]:
    """Run the experiment, write figures, models, `reproduce.txt` and `reproduce.json` to a folder."""
    folder = Path(output)
    folder.mkdir(parents=True, exist_ok=True)
    lines: list[str] = []

    def tell(text: str) -> None:
        lines.append(text)
        say(text)

    step = progress or (lambda text: None)
    tell(trim_text())
    step("simulating the recordings")
    up, down = (simulate(make_run("pulses", a)) for a in (SMALL, -SMALL))
    large = [simulate(make_run("pulses", a)) for a in (LARGE, -LARGE)]
    noisy = [simulate(make_run("pulses", a, NOISE, seed)) for a, seed in ((LARGE, 1), (-LARGE, 2))]
    check, noisy_check = simulate(make_run("check")), simulate(make_run("check", noise=NOISE, seed=4))
    paper, both, wide = f"+{SMALL:.0%} (the paper's)", f"±{SMALL:.0%}", f"±{LARGE:.0%}"
    fits = [
        (paper, [up], check, "none"),
        (both, [up, down], check, "none"),
        (f"+{LARGE:.0%}", large[:1], check, "none"),
        (wide, large, check, "none"),
        *((f"{wide}, noise {NOISE:g}", noisy, noisy_check, additive) for additive in ("none", "noise")),
    ]
    wanted = [(*of, criterion) for of in fits for criterion in ("qp", "lp")]
    cases = []
    for number_of, case in enumerate(wanted, start=1):
        step(CountedStep(f"fit {number_of} of {len(wanted)}: {case[0]}", number_of, len(wanted)))
        cases.append(fit_and_check(*case))
    tell(cases_text(cases))
    tell(width_text(cases))
    first, chosen = cases[0], next(c for c in cases if c.numbers["identified_from"] == wide)
    tell(eigenvalue_text({f"(10) from {paper}": first.model, f"(10) from {wide}": chosen.model}))
    tell(matrix_text(chosen.model, f"(10) from {wide}"))
    for model, _, numbers in cases:
        name = "_".join(_identified(numbers)).replace(" (the paper's)", "").replace(", noise 0.0001", "_noise")
        name = name.replace("±", "both").replace("+", "up").replace("%", "")
        model.save(folder / f"{name}.model.json")
    for name, (model, verdicts, _) in (("check", chosen), ("check_paper_pulses", first)):
        save(envelope_figure(model, verdicts), folder / f"{name}.png")
        save(utilisation_figure(model, verdicts), folder / f"{name}_utilisation.png")
    published = [[v.real, v.imag] for v in leibov2006().eigenvalues().tolist()]
    data = {"cases": [c.numbers for c in cases], "published_eigenvalues": published}
    for name, text in (("reproduce.json", json.dumps(data, indent=1)), ("reproduce.txt", "\n\n".join(lines))):
        with whole_file(folder / name) as stream:
            stream.write(f"{text}\n".encode())
    say(f"models, figures (check*.png), reproduce.txt and reproduce.json are in {folder}")
    return data


def trim_text() -> str:
    """Steady states at 68 and 60 deg."""
    rows = [
        [f"{t.pla:g} deg", f"{t.x[0]:.0f}", f"{t.x[1]:.0f}", f"{p.thrust / 1e3:.1f}", f"{p.specific_consumption:.3f}",
         f"{p.W2:.1f}", f"{p.overall_pressure_ratio:.1f}", f"{p.bypass_ratio:.2f}", f"{p.T4:.0f}", f"{p.T5:.0f}",
         f"{p.fuel:.3f}"]
        for t, p in ((t, t.path) for t in map(trim, (68.0, 60.0)))
    ]  # fmt: skip
    header = ("PLA", "N1 [rpm]", "N2 [rpm]", "thrust [kN]", "kg/(kgf h)", "air [kg/s]", "P3/P2", "bypass", "T4 [K]",
              "T5 [K]", "fuel [kg/s]")  # fmt: skip
    return "Steady states of the nonlinear engine, sea level, at rest\n" + str(Table(header, rows))


def cases_text(cases: Sequence[Case]) -> str:
    """Shares of the check inside."""
    rows = [
        [*_identified(c), str(c["outside_identification"]), f"{c['inside_all']:.0%}",
         *(f"{share:.0%}" for share in c["inside"]), str(c["outside_domain"])]
        for c in (case.numbers for case in cases)
    ]  # fmt: skip
    header = ("identified from", "", "additive", "outside fit", "all", *SHORT, "outside domain")
    title = "Check: lever from 68 to 60 deg, 100 transitions; shares inside the one-step bounds"
    return f"{title}\n{Table(header, rows)}"


def width_text(cases: Sequence[Case]) -> str:
    """Widths and discrepancies over the check."""
    rows = [
        [*_identified(c), *(f"{1e4 * w:.2f}" for w in c["mean_width"]), number(c["discrepancy_4"]),
         *(number(1e4 * e) for e in c["discrepancy_5"])]
        for c in (case.numbers for case in cases)
    ]  # fmt: skip
    x = cases[0].model.operating_point.normalise_x(cases[0].verdicts.transient.x)
    step = np.sqrt(np.mean(np.diff(x, axis=0) ** 2, axis=0))
    rows.append(["rms step of the check", "", "", *(f"{1e4 * s:.2f}" for s in step)] + [""] * 6)
    header = ("identified from", "", "additive", *SHORT, "(4)", *(f"(5) {s}" for s in SHORT))
    return (
        "Mean width of the bounds over the check, and discrepancies (4) and (5) of the nominal model's free run;\n"
        "widths and (5) in 1e-4 of the scale\n" + str(Table(header, rows))
    )


def _identified(numbers: dict[str, Any]) -> list[str]:
    return [numbers[key] for key in ("identified_from", "criterion", "additive")]


def eigenvalue_text(models: dict[str, UncertainLTI]) -> str:
    """Eigenvalues compared with the published ones."""
    point, plant = operating_point(), engine()
    A = plant.linearise(point.x_s, point.u_s, point.X, point.U)[0]
    sampled = (expm(A * DT) - np.eye(len(A))) / DT
    every = {"published": leibov2006().A, "engine, linearised": A, "the same over one step": sampled}
    every |= {name: model.A for name, model in models.items()}
    rows = []
    for name, matrix in every.items():
        values = sorted(np.linalg.eigvals(matrix).tolist(), key=lambda v: (-v.real, v.imag))
        rows.append([name, *(f"{v.real:.2f}{v.imag:+.2f}j" if abs(v.imag) > 1e-9 else f"{v.real:.2f}" for v in values)])
    title = "Eigenvalues of A [1/s]; over one step: (exp(A Δt) - I) / Δt, what (3) sees of the same engine"
    return f"{title}\n{Table(('', '1', '2', '3', '4', '5'), rows)}"


def matrix_text(model: UncertainLTI, name: str) -> str:
    """A, B and their half-widths compared with the published ones."""
    parts = []
    for title, m in (("published", leibov2006()), (name, model)):
        nominal, half = np.hstack([m.A, m.B]), np.hstack([m.dA, m.dB])
        each = zip(SHORT, nominal, half, strict=True)
        rows = [[name, *(f"{a:.2f} ± {d:.2g}" for a, d in zip(*of, strict=True))] for name, *of in each]
        parts.append(f"A, B [1/s], {title}\n{Table(('', *SHORT, *SHORT_CONTROLS), rows)}")
    return "\n\n".join(parts)
