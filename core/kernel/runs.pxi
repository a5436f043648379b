# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""The states several steps on, as they come: a run from each measured state, and envelopes around where it leads."""


@cython.final
cdef class Runs:
    """Runs, one from each measured state, and what the horizons say of the states they lead to.

    `judge`: of the model, whose last transition a run begins at; `horizons`: envelopes after a number of steps, the
    shortest first, at least one; `runner`: of the elements that are run, default the nominal ones of the model;
    `residuals`: x less the centre, normalised, where the last `push` gives the utilisation; the next one writes there.
    """

    cdef readonly Py_ssize_t count
    cdef readonly arrays.array residuals
    cdef Judge judge, runner
    cdef Py_ssize_t longest
    cdef Py_ssize_t under_way  # runs, in the first places
    cdef Py_ssize_t newest
    cdef list elements, _keep
    cdef long long* steps
    cdef double* x  # state of each run, row by row; the last one is foreseen, as of the six below
    cdef double* time
    cdef double* control
    cdef double* start  # state at which each run began
    cdef Py_ssize_t* places  # blocks that held there
    cdef double* weights
    cdef double* modes  # of the transition before
    cdef double* phi  # beyond the states and the mean controls 1

    def __init__(self, Judge judge, horizons, Judge runner=None):
        cdef Py_ssize_t n = judge.n, m = judge.size - judge.n, p = judge.elements.p
        runner = judge if runner is None else runner
        if (runner.n, runner.size, runner.total, runner.elements.p, runner.blocks.count) != (
            n, judge.size, judge.total, p, judge.blocks.count,
        ):
            raise ValueError("the runner does not fit the model")
        tables = [horizon.tables for horizon in horizons]
        lead = () if judge.blocks.count == 1 and tables[0][0].ndim == 2 else (judge.blocks.count,)
        steps = [horizon.steps for horizon in horizons]
        fits = [theta.shape == (*lead, n, p) and v.shape == (*lead, n) for theta, _, v in tables]
        if not (all(fits) and steps == sorted(steps)):
            raise ValueError("the horizons do not fit the model")
        self.judge, self.runner, self.count, self.longest = judge, runner, len(steps), max(steps)
        cdef Py_ssize_t most = self.longest + 1
        cdef arrays.array room = doubles(np.zeros(most * (2 * n + m + 1 + _CORNERS) + 2 + p))
        cdef arrays.array places = array("q", bytes(8 * _CORNERS * most)), lengths = array("q", steps)
        self._keep, self.elements = [room, places, lengths], [Elements(*table) for table in tables]
        self.x, self.steps, self.places = room.data.as_doubles, lengths.data.as_longlongs, <Py_ssize_t*>places.data.as_longlongs
        self.start, self.control = self.x + n * most, self.x + 2 * n * most
        self.time = self.control + m * most
        self.weights = self.time + most
        self.modes = self.weights + _CORNERS * most
        self.phi = self.modes + 2
        for i in range(p):
            self.phi[i] = 1.0
        self.residuals = array("d", [NAN] * (self.count * n))
        self.reset()

    def reset(self):
        """End every run: what comes next does not follow what was before."""
        self.under_way = 0
        self.newest = -1

    def push(self, before, after, double dt):
        """Begin a run, take all a step further, and compare those that have gone far enough with the state there.

        `before` was judged last. Returns (count n,): utilisation, of a size of at most 1 exactly where contained; NaN
        where no run has gone far enough.
        """
        cdef Judge judge = self.judge
        cdef Py_ssize_t i, k, h, n = judge.n, most = self.longest + 1
        cdef double value, half, x_next
        cdef bint inside
        cdef Elements elements
        self._begin()
        self.runner.step(self.x, self.time, self.control, most, 0, self.under_way, dt)
        cdef arrays.array found = arrays.clone(array_of_doubles, self.count * n, False)
        cdef double* values = found.data.as_doubles
        for i in range(self.count * n):
            values[i] = self.residuals.data.as_doubles[i] = NAN
        for h in range(self.count):
            if self.steps[h] > self.under_way:
                break
            k = self.newest - <Py_ssize_t>self.steps[h] + 1
            if k < 0:
                k += self.longest
            elements = self._sum(h, k)
            for i in range(n):
                x_next = normalised(after[i], judge.steady[i], judge.scale[i])
                value = centre_of(self.x[i * most + k], self.time[k], elements.rate[i])
                half = half_of(self.time[k], elements.spread[i], elements.still[i])
                inside = is_contained(lower_of(value, half, 1.0), x_next, upper_of(value, half, 1.0))
                self.residuals.data.as_doubles[h * n + i] = x_next - value
                values[h * n + i] = settled_of(utilisation_of(x_next - value, half), inside)
        return found

    def foresee(self, before, double dt):
        """Bounds (2 n,) at the end of the longest horizon, if controls and further scheduling signals stay."""
        cdef Judge judge = self.judge, runner = self.runner
        cdef Py_ssize_t i, n = judge.n, k = self.longest, most = self.longest + 1
        cdef double value, half
        cdef double* end
        if len(before) != judge.total:
            raise ValueError(f"{len(before)} values for {judge.total} signals")
        if runner.read(before) < 0:
            return None
        self._begin_at(k, runner)
        for _ in range(self.longest):
            runner.step(self.x, self.time, self.control, most, k, k + 1, dt)
        cdef Elements elements = self._sum(self.count - 1, k)
        cdef arrays.array found = arrays.clone(array_of_doubles, 2 * n, False)
        end = found.data.as_doubles
        for i in range(n):
            value = centre_of(self.x[i * most + k], self.time[k], elements.rate[i])
            half = half_of(self.time[k], elements.spread[i], elements.still[i])
            end[i] = recorded(lower_of(value, half, judge.margin), judge.steady[i], judge.scale[i])
            end[n + i] = recorded(upper_of(value, half, judge.margin), judge.steady[i], judge.scale[i])
        return found

    cdef void _begin(self) noexcept:
        """Begin a run at the transition that was judged last; where a mode changes the others end."""
        cdef Judge judge = self.judge, runner = self.runner
        cdef Py_ssize_t i
        for i in range(judge.blocks.axes):
            if judge.blocks.of_modes[i]:
                if self.under_way and judge.s[i] != self.modes[i]:
                    self.reset()
                self.modes[i] = judge.s[i]
        self.newest = self.newest + 1 if self.newest + 1 < self.longest else 0
        self.under_way += self.under_way < self.longest
        self._begin_at(self.newest, judge)
        if runner is not judge:
            for i in range(judge.size):
                runner.phi[i] = judge.phi[i]
            for i in range(judge.blocks.corners):
                runner.places[i], runner.weights[i] = judge.places[i], judge.weights[i]

    cdef void _begin_at(self, Py_ssize_t k, Judge judge) noexcept:
        """A run in place k, from the transition that was taken."""
        cdef Py_ssize_t i, n = judge.n, most = self.longest + 1
        for i in range(n):
            self.x[i * most + k] = self.start[i * most + k] = judge.phi[i]
        for i in range(judge.size - n):
            self.control[i * most + k] = 0.0
        self.time[k] = 0.0
        for i in range(judge.blocks.corners):
            self.places[_CORNERS * k + i], self.weights[_CORNERS * k + i] = judge.places[i], judge.weights[i]

    cdef Elements _sum(self, Py_ssize_t h, Py_ssize_t k):
        """The sums of a horizon, with the blocks that held where run k began."""
        cdef Judge judge = self.judge
        cdef Elements elements = self.elements[h]
        cdef Py_ssize_t i, n = judge.n, most = self.longest + 1
        for i in range(n):
            self.phi[i] = self.start[i * most + k]
        for i in range(judge.size - n):
            self.phi[n + i] = self.control[i * most + k] / self.time[k]
        elements.sum(self.phi, self.places + _CORNERS * k, self.weights + _CORNERS * k, judge.blocks.corners)
        return elements
