# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

# cython: boundscheck=False, wraparound=False, cdivision=True, initializedcheck=False

"""Sampler: a stream of messages becomes samples (t, x, u), one message after another or all of a recording at once."""

import math

import numpy as np

cimport cython
from libc.math cimport NAN, isfinite, rint
from libc.stdlib cimport calloc, free, realloc
from libc.string cimport memcpy

from uncertain_lti.base.text import plural
from uncertain_lti.base.errors import SignalError
from uncertain_lti.sampling.clock import to_ns
from uncertain_lti.sampling.clock import INVALID, LATE, MISSING, TOO_OLD, Counters, Status
from uncertain_lti.signals.field_path import FieldPath

BUFFERED_MESSAGES = 10_000
"""Messages kept per topic that wait for a later sample; at this many, all but the later half and the one that the
open sample has chosen so far are forgotten."""
REMEMBERED_SAMPLES = 100
"""Closed samples that a message is compared with to find whether it came late."""
KEPT_OVER_A_JUMP = 100
"""Messages kept per topic, whatever has been chosen, once its time has stepped back and the clock's has not yet."""

cdef enum Outcome:
    _NONE, _OK, _FIRST, _RESET, _GAP, _MISSING, _EQUAL, _SHORT, _LATE, _UNSTAMPED
cdef list _STATUS = [
    None, Status.OK, Status.FIRST, Status.RESET, Status.GAP, Status.MISSING, Status.EQUAL, Status.SHORT, Status.LATE,
    Status.UNSTAMPED,
]  # of each outcome; looking one of an enumeration up is slow
cdef enum:
    _LAG, _DIFF, _RATE

ctypedef long long instant_t


@cython.final
cdef class Step:
    """One decided clock message: the sample k+1 and the transition that ends in it.

    All values are in recorded units, with NaN for what is missing. Without a sample k (first, reset) x and u are all
    NaN and dt is NaN; for a dropped message x_next is NaN as well.

    `status`: what became of the message; `t_ns`: instant t_{k+1}, ns; `arrival_ns`: arrival of the message, ns; `dt`:
    Δt_k, s; `before`: x, u and the further scheduling signals s of sample k; `after`: x of sample k+1.
    """

    cdef readonly object status, t_ns, arrival_ns, before, after
    cdef readonly double dt

    def __init__(self, status, t_ns, arrival_ns, double dt, before, after):
        self.status, self.t_ns, self.arrival_ns, self.dt = status, t_ns, arrival_ns, dt
        self.before, self.after = before, after

    @property
    def x(self):
        """State at t_k (n,)."""
        return np.array(self.before[: len(self.after)], dtype=np.float64)

    @property
    def u(self):
        """Controls at t_k, and after them the further scheduling signals (m + q,)."""
        return np.array(self.before[len(self.after) :], dtype=np.float64)

    @property
    def x_next(self):
        """State at t_{k+1} (n,)."""
        return np.array(self.after, dtype=np.float64)


cdef inline void unknown(double* values, Py_ssize_t count) noexcept:
    cdef Py_ssize_t i
    for i in range(count):
        values[i] = NAN


include "topic.pxi"


@cython.final
cdef class Memory:
    """The last values of one signal in a segment, and what it takes from them."""

    cdef Py_ssize_t place, size, count, at
    cdef int kind
    cdef double[::1] line

    def __init__(self, Py_ssize_t place, Py_ssize_t back, int kind):
        self.place, self.size, self.kind, self.line = place, back + 1, kind, np.zeros(back + 1)

    cdef double take(self, double value, double dt, bint final) noexcept:
        """What is taken at one more sample, which stays if it is final."""
        cdef Py_ssize_t count = self.count + 1 if self.count < self.size else self.size
        cdef Py_ssize_t at = (self.at + 1) % self.size
        cdef double oldest = self.line[at]
        if final:
            self.line[self.at], self.at, self.count = value, at, count
        if count < self.size:
            return NAN
        return oldest if self.kind == _LAG else value - oldest if self.kind == _DIFF else (value - oldest) / dt


@cython.final
cdef class Sampler:
    """Messages in order of arrival in, one `Step` per clock message out, as soon as it is decided.

    A clock message opens sample k at its instant; the next accepted clock message closes it, and only then are
    u(t_k) and the states of other topics fixed: the message with the greatest stamp <= t_k among those arrived,
    ties to the latest arrival. A step is decided when its second sample opens, or, where states come from more
    than one topic or a control at the arrival from another one, when that sample closes. Nothing is resampled.

    `signals`: with clock, max_gap and a time source for every topic resolved (`reading.read_transients` and the model
    file do that); `counters`: samples, gaps, resets and missing; dropped messages by status value; `late <topic>` for
    messages that came after the sample they belonged to was closed; `missing <signal>` and `stale <signal>` per sample;
    `invalid <signal>` per message whose value is outside `valid` or in `ignore`; `number`: samples opened so far.
    """

    cdef readonly object signals
    cdef readonly str clock
    cdef readonly instant_t max_gap_ns, min_step_ns
    cdef Py_ssize_t n, total
    cdef dict _places
    cdef list topics, others, memories
    cdef Topic clock_topic
    cdef bint at_once  # the clock message carries all that the step to it needs
    cdef list at_end  # places of the controls that act as they are at the end of a step
    cdef list of_last  # places of the controls that the last sample of a pass has, whatever comes
    cdef double period  # s; 0 where Δt is that of the stamps
    cdef object _counters
    cdef Py_ssize_t samples, gaps, resets, missing
    cdef Py_ssize_t[::1] late, old, lacking, invalid, dropped
    # sample k: the clock message that opened it, and how many did before
    cdef Message open
    cdef readonly Py_ssize_t number
    cdef int open_status
    cdef double open_dt
    cdef bint closed_one  # there is z of sample k-1, fixed when it closed
    cdef object _room
    cdef double* z
    cdef double* before
    # the step that was decided last
    cdef int status
    cdef instant_t t_ns, arrival_ns
    cdef double dt
    cdef double* departure
    cdef double* arrival

    def __init__(self, signals):
        if signals.clock is None or signals.max_gap is None:
            raise SignalError(f"{signals.source}: clock and max_gap must be resolved before sampling")
        if signals.step == "constant":
            raise SignalError(f"{signals.source}: the constant step must be resolved before sampling")
        unsaid = [t for t in signals.topics if t not in signals.time]
        if unsaid:
            raise SignalError(f"{signals.source}: the time source of {', '.join(unsaid)} is not resolved")
        self.signals, self.clock = signals, signals.clock
        self.max_gap_ns, self.min_step_ns = to_ns(signals.max_gap), to_ns(signals.min_step)
        self.n, self.total = len(signals.states), len(signals)
        max_age = [to_ns(signals.longest_age(i)) for i in range(self.total)]
        self._places = {topic: i for i, topic in enumerate(signals.topics)}
        self.topics = [Topic(signals, topic, max_age) for topic in signals.topics]
        self.clock_topic = self.topics[self._places[self.clock]]
        self.others = [topic for topic in self.topics if topic is not self.clock_topic]
        self.at_once, self.at_end = signals.decided_at_once, list(signals.arrivals)
        held = signals.on(signals.clock) if self.at_once else range(self.total)
        self.of_last = [
            i for i in held if i >= self.n and signals[i].at == "departure" and not signals[i].delay and not signals[i].memory
        ]
        self.memories = []
        for i, signal in enumerate(signals):
            memory = signal.memory
            if signal.delay or (memory is not None and memory.kind == "lag"):
                self.memories.append(Memory(i, memory.samples if memory is not None else signal.delay, _LAG))
            elif memory is not None:
                self.memories.append(Memory(i, 1, _DIFF if memory.kind == "diff" else _RATE))
        self.period = 0.0 if isinstance(signals.step, str) else signals.step
        self._counters = Counters()
        self.late, self.dropped = np.zeros(len(self.topics), dtype=np.intp), np.zeros(_UNSTAMPED + 1, dtype=np.intp)
        self.old, self.lacking, self.invalid = np.zeros((3, self.total), dtype=np.intp)
        self.open.values = self.clock_topic.left_one.values  # which no other use is made of
        self._room = np.full(3 * self.total + self.n, NAN)
        cdef double[::1] room = self._room
        self.z, self.before, self.departure = &room[0], &room[self.total], &room[2 * self.total]
        self.arrival = self.departure + self.total

    @property
    def counters(self):
        """Counts so far."""
        found = self._counters
        cdef Py_ssize_t i
        if self.samples:
            found["samples"] += self.samples
        if self.gaps:
            found["gaps"] += self.gaps
        if self.resets:
            found["resets"] += self.resets
        if self.missing:
            found["missing"] += self.missing
        self.samples = self.gaps = self.resets = self.missing = 0
        for i in range(_EQUAL, _UNSTAMPED + 1):
            if self.dropped[i]:
                found[_STATUS[i].value] += self.dropped[i]
                self.dropped[i] = 0
        for i in range(len(self.topics)):
            if self.late[i]:
                found.add(LATE, (<Topic>self.topics[i]).name, self.late[i])
                self.late[i] = 0
        for i in range(self.total):
            if self.old[i]:
                found.add(TOO_OLD, self.signals[i].name, self.old[i])
            if self.lacking[i]:
                found.add(MISSING, self.signals[i].name, self.lacking[i])
            if self.invalid[i]:
                found.add(INVALID, self.signals[i].name, self.invalid[i])
            self.old[i] = self.lacking[i] = self.invalid[i] = 0
        return found

    @counters.setter
    def counters(self, counts):
        _ = self.counters
        self._counters = counts

    def push(self, str topic, instant_t arrival_ns, stamp_ns, values):
        """Take one message."""
        cdef Topic state = self.topics[self._places[topic]]
        cdef Message* message = state.free_one()
        cdef Py_ssize_t i = 0
        if len(values) != state.width:
            raise ValueError(f"{topic}: {plural(len(values), 'value')} for {plural(state.width, 'signal')}")
        for value in values:
            message.values[i] = value
            i += 1
        message.arrival = arrival_ns
        message.stamp = stamp_ns if state.header and stamp_ns is not None and stamp_ns > 0 else 0
        if not self.take(self._places[topic], message):
            return []
        before, after = [self.departure[i] for i in range(self.total)], [self.arrival[i] for i in range(self.n)]
        return [Step(_STATUS[self.status], self.t_ns, self.arrival_ns, self.dt, before, after)]

    def push_all(self, const long long[::1] topic, const long long[::1] arrival, const long long[::1] stamp, values):
        """Take all messages of a recording.

        `topic` (messages,): position in `signals.topics` of each, in order of arrival; `arrival` (messages,): ns;
        `stamp` (messages,): ns, zero or less where there is none; `values` (messages of the topic, signals on it): of
        each topic. Returns t_ns (N+1,), x (N+1, n) and u with the further scheduling signals (N+1, m + q) of the
        samples; and of every clock message, as they were decided, what `reading.Decisions` holds.
        """
        cdef Py_ssize_t k, i, row = -1, number = 0, clock = self._places[self.clock], at = -1
        cdef Py_ssize_t n = self.n, held = self.total - self.n, most = np.count_nonzero(np.asarray(topic) == clock)
        cdef Topic state
        cdef Message* message
        cdef const double[:, ::1] table
        tables = [np.ascontiguousarray(some, dtype=np.float64) for some in values]
        for state, some in zip(self.topics, tables, strict=True):
            if some.ndim != 2 or some.shape[1] != state.width:
                raise ValueError(f"{state.name}: the values do not fit the signals")
        counts = np.bincount(np.asarray(topic), minlength=len(tables)) if len(topic) else np.zeros(len(tables), dtype=int)
        if not len(topic) == len(arrival) == len(stamp) or counts.tolist() != [len(some) for some in tables]:
            raise ValueError("the messages do not fit the topics")
        cdef Py_ssize_t[::1] next_row = np.zeros(len(tables), dtype=np.intp)
        pointers = np.array([some.ctypes.data for some in tables], dtype=np.intp)
        cdef Py_ssize_t[::1] begins = pointers
        t_ns, x, u = np.empty(most, np.int64), np.empty((most, n)), np.full((most, held), NAN)
        cdef long long[::1] instants = t_ns
        cdef double[:, ::1] states = x
        cdef double[:, ::1] controls = u
        came, when, by = np.empty((3, most), np.int64)
        gone = np.empty(most, dtype=bool)
        cdef long long[::1] decided_at = came
        cdef long long[::1] decided = when
        cdef long long[::1] decided_by = by
        cdef unsigned char[::1] dropped = gone.view(np.uint8)
        for k in range(topic.shape[0]):
            i = topic[k]
            state = <Topic>self.topics[i]
            message = state.free_one()
            memcpy(
                message.values, (<const double*>begins[i]) + next_row[i] * state.width, state.width * sizeof(double)
            )
            next_row[i] += 1
            message.arrival = arrival[k]
            message.stamp = stamp[k] if state.header and stamp[k] > 0 else 0
            at += i == clock
            if not self.take(i, message):
                continue
            decided_at[number], decided_by[number] = arrival[k], at
            decided[number], dropped[number] = self.t_ns, self.status >= _EQUAL
            number += 1
            if self.status >= _EQUAL:
                continue
            for i in range(held if row >= 0 else 0):  # fixed only now that the next sample has arrived
                controls[row, i] = self.departure[n + i]
            if self.at_once and row >= 0 and self.status == _RESET:
                for i in self.of_last:
                    controls[row, i - n] = self.before[i]
            row += 1
            instants[row] = self.t_ns
            for i in range(n):
                states[row, i] = self.arrival[i]
        if row >= 0 and self.at_once:
            self.fix(False, False)
            for i in self.of_last:
                controls[row, i - n] = self.z[i]
        elif row >= 0 and self.open_status != _RESET:
            for i in self.of_last:
                controls[row, i - n] = self.before[i]
        return (t_ns[: row + 1], x[: row + 1], u[: row + 1]), (came[:number], when[:number], gone[:number], by[:number])

    cdef bint take(self, Py_ssize_t place, Message* message) except -1:
        """Take the message that lies in `free_one` of a topic; whether a step was decided."""
        cdef Topic state = <Topic>self.topics[place]
        cdef Message* sample = &self.open if self.number else NULL
        if state.limited:
            self.admit(state, message)
        if state is self.clock_topic:
            return self.take_clock(message)
        if state.steps_back(message, self.max_gap_ns):
            state.start_anew(sample, self.number, message)
        elif state.closed_count and state.came_late(message):
            self.late[place] += 1
        if state.unwrap:
            state.turn(message.values)
        state.append(sample, self.number)
        return False

    cdef int admit(self, Topic state, Message* message) except -1:
        """NaN for values that do not count."""
        cdef Py_ssize_t i
        cdef double value, low, high, other
        cdef bint refused
        cdef const double[::1] ignored
        memcpy(message.values + state.width, message.values, state.width * sizeof(double))
        for i, low, high, ignored in state.limited:
            value = message.values[i]
            refused = value < low or value > high
            for other in ignored:
                refused |= value == other
            if refused:
                message.values[i] = NAN
                self.invalid[state.where[i]] += 1
        return 0

    cdef bint take_clock(self, Message* message) except -1:
        cdef Topic state = self.clock_topic
        cdef instant_t instant = message.stamp if state.header else message.arrival, step
        cdef double dt = NAN
        cdef int status = _FIRST
        cdef bint decided
        cdef Py_ssize_t i
        cdef Memory memory
        if state.header and not instant:
            return self.drop(_UNSTAMPED, message.arrival, message)
        if self.number:
            step = instant - self.open_ns()
            if step == 0:
                return self.drop(_EQUAL, instant, message)
            if 0 < step < self.min_step_ns:
                return self.drop(_SHORT, instant, message)
            if -self.max_gap_ns <= step < 0:
                return self.drop(_LATE, instant, message)
            status = _OK if 0 < step <= self.max_gap_ns else _GAP if step > 0 else _RESET
            dt = step * 1e-9 if step > 0 else NAN
            if self.period > 0.0 and status == _OK:
                dt = self.period
        if status != _OK:  # a segment begins
            state.previous[:] = state.steady
        if state.unwrap:
            state.turn(message.values)
        decided = False
        if self.number:
            self.fix(True, status == _RESET)
            if not self.at_once:
                self.decide(self.open_status, self.open_ns(), self.open.arrival, self.open_dt, status == _RESET)
                decided = True
            memcpy(self.before, self.z, self.total * sizeof(double))
            self.closed_one = True
        if status != _OK:
            for memory in self.memories:
                memory.count = memory.at = 0
        if self.at_once:
            unknown(self.z, self.total)
            self.put(state, message, 0)
            self.decide(status, instant, message.arrival, dt, False)
            decided = True
        self.open.arrival, self.open.stamp = message.arrival, message.stamp
        memcpy(self.open.values, message.values, state.width * sizeof(double))
        self.number += 1
        self.open_status, self.open_dt = status, dt
        self.samples += 1
        self.gaps += status == _GAP
        self.resets += status == _RESET
        return decided

    cdef inline instant_t open_ns(self) noexcept:
        return self.open.stamp if self.open.stamp else self.open.arrival

    cdef bint drop(self, int status, instant_t instant, Message* message) noexcept:
        self.dropped[status] += 1
        self.status, self.t_ns, self.arrival_ns, self.dt = status, instant, message.arrival, NAN
        unknown(self.departure, self.total + self.n)  # and the arrival behind it
        return True

    cdef int decide(self, int status, instant_t instant, instant_t arrival, double dt, bint left) except -1:
        """The step to a sample, of which `z` is what is known; left: time has stepped back since, so nothing is."""
        cdef Py_ssize_t i
        cdef bint whole = True
        if not self.closed_one or status == _FIRST or status == _RESET:
            unknown(self.departure, self.total)
        else:
            memcpy(self.departure, self.before, self.total * sizeof(double))
            for i in self.at_end:
                self.departure[i] = NAN if left else self.z[i]
        for i in range(self.n):
            self.arrival[i] = self.z[i]
            whole &= isfinite(self.z[i]) != 0
        for i in range(self.total if status == _OK else 0):
            whole &= isfinite(self.departure[i]) != 0
        if status == _OK and not whole:
            status = _MISSING
            self.missing += 1
        self.status, self.t_ns, self.arrival_ns, self.dt = status, instant, arrival, dt
        return 0

    cdef int fix(self, bint final, bint reset) except -1:
        """z = [x; u; s] of the open sample from what has arrived; final: the sample closes now; reset: by a step back.
        """
        cdef Topic state
        cdef Memory memory
        cdef Message* chosen
        cdef Py_ssize_t i
        cdef instant_t age
        unknown(self.z, self.total)
        self.put(self.clock_topic, &self.open, 0)
        for state in self.others:
            chosen = state.choose(&self.open, self.number)
            if chosen != NULL:
                age = behind_of(self.open.arrival, self.open.stamp, chosen.arrival, chosen.stamp)
                self.put(state, chosen, age)
                for i in range(state.width if final else 0):
                    self.old[state.where[i]] += age > state.max_age[i]
            if final:
                state.close(&self.open, chosen, reset)
        for memory in self.memories:
            self.z[memory.place] = memory.take(self.z[memory.place], self.open_dt, final)
        for i in range(self.total if final else 0):
            self.lacking[i] += not isfinite(self.z[i])
        return 0

    cdef void put(self, Topic state, Message* message, instant_t age) noexcept:
        """The values of a message in their places in z, as far as they are not too old."""
        cdef Py_ssize_t i
        for i in range(state.width):
            if age <= state.max_age[i]:
                self.z[state.where[i]] = message.values[i]

    def kept(self, str topic):
        """Messages of a topic that may still be chosen, oldest first, as (stamp, arrival, values as received)."""
        cdef Topic state = self.topics[self._places[topic]]
        cdef Message* message
        cdef Py_ssize_t i, k
        found = []
        for k in range(state.head, state.head + state.count):
            message = state.kept[k]
            values = [message.values[i] for i in range(state.width)]
            for i, *_ in state.limited:
                if values[i] != values[i]:
                    values[i] = message.values[state.width + i]
            found.append((message.stamp, message.arrival, values))
        return found

    def latest(self):
        """The open sample with what is known so far."""
        cdef Py_ssize_t i
        if not self.number:
            return None
        self.fix(False, False)
        return self.open_ns(), [self.z[i] for i in range(self.total)]


def all_finite(values):
    """Whether all are finite."""
    return math.isfinite(sum(values)) or all(map(math.isfinite, values))  # a sum of finite numbers may overflow
