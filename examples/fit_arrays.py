# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Fit a model to arrays and check other arrays with it: no bag, no signals file, no ROS.

A motor drives a load through a soft shaft. Its speed and the load's are measured every 10 ms with a little noise; the
control is the torque. In the run that is checked, friction of the load rises at 12 s.
"""

import numpy as np

from uncertain_lti import EnvelopeMonitor, Transient, fit

DT = 0.01  # s
NOISE = 0.01  # rad/s, standard deviation


def recorded(seed: int, friction_from: float = np.inf) -> Transient:
    """Simulate 20 s of the motor under random steps of torque.

    Parameters
    ----------
    seed : int
        Of the torque and of the noise.
    friction_from : float
        Time from which the load has twenty times its friction, s.

    Returns
    -------
    Transient
        Speeds in rad/s, torque in N m.
    """
    rng = np.random.default_rng(seed)
    t = np.arange(2001) * DT
    torque = np.repeat(rng.uniform(-2.0, 2.0, 41), 50)[: len(t)]
    speed = np.zeros((len(t), 2))  # of motor and load
    for k in range(len(t) - 1):
        motor, load = speed[k]
        shaft = 1.5 * (motor - load)  # N m: the shaft passes torque on as its ends slip
        friction = 2.0 if t[k] >= friction_from else 0.1  # N m s
        speed[k + 1] = speed[k] + DT * np.array(
            [(torque[k] - shaft - 0.1 * motor) / 0.2, (shaft - friction * load) / 0.4]
        )
    noisy = speed + NOISE * rng.standard_normal(speed.shape)
    return Transient(t, noisy, torque, name=f"run {seed}", state_names=["motor", "load"], control_names=["torque"])


def main() -> None:
    """Fit three healthy runs; check a healthy and a changed one."""
    model = fit([recorded(seed) for seed in range(1, 7)])
    facts = model.fit_summary
    print(f"{facts['transitions']} transitions fitted, {facts['violations']} outside")
    print(f"half-width of the noise: {', '.join(f'{v:.2f}' for v in model.v)} rad/s")

    monitor = EnvelopeMonitor(model)
    for name, run in (("healthy", recorded(4)), ("friction from 12 s", recorded(4, friction_from=12.0))):
        verdicts = monitor.check(run)
        alarms = run.t[verdicts.alarm]
        first = f"first alarm at {alarms[0]:.2f} s" if len(alarms) else "no alarm"
        print(f"{name}: {np.count_nonzero(verdicts.violated)} of {len(run) - 1} steps violated, {first}")


if __name__ == "__main__":
    main()
