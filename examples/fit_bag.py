# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Fit a model to shipped recordings, check another one, and draw it: `python examples/fit_bag.py [FIGURE.png]`."""

import sys
from pathlib import Path

from uncertain_lti import EnvelopeMonitor, fit, read_transients
from uncertain_lti.reports.figures import envelope_figure, save

ROOT = Path(__file__).resolve().parents[1]
ONSET = 24.0  # s: the fan is damaged


def main(figure: str = "envelope.png") -> None:
    """Fit, check and draw.

    Parameters
    ----------
    figure : str
        File to write.
    """
    healthy = sorted((ROOT / "bags").glob("turbofan_*_noise.mcap"))
    runs = read_transients(healthy, ROOT / "config" / "signals" / "turbofan.yaml")
    model = fit(runs)
    print(f"{len(runs)} recordings fitted, {model.fit_summary['violations']} transitions outside")

    # signals with everything resolved: the same clock, steady states and scales as in the fit
    (damaged,) = read_transients(ROOT / "bags" / "turbofan_fan_damage.mcap", model.signals)
    verdicts = EnvelopeMonitor(model).check(damaged)
    first = damaged.t[verdicts.alarm][0]
    print(f"fan damaged at {ONSET:g} s, first alarm at {first:.3f} s")

    states = ["fan_speed", "compressor_exit_total_pressure"]
    save(envelope_figure(model, verdicts, states, event=(ONSET, "fan damaged"), span=(23.0, 25.0)), figure)
    print(f"figure written to {figure}")


if __name__ == "__main__":
    main(*sys.argv[1:])
