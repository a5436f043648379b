# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""Messages of one topic that may still be chosen, and which of them is."""

cdef struct Message:
    instant_t arrival, stamp  # ns; 0 for no stamp
    double* values  # and behind them these as received


cdef struct Closed:
    instant_t arrival, stamp  # of a sample
    bint chose
    instant_t chosen_arrival, chosen_stamp


cdef struct Forgotten:
    bint some
    instant_t first, last  # instants of what there was no room for


cdef inline instant_t behind_of(instant_t arrival, instant_t stamp, instant_t of_arrival, instant_t of_stamp) noexcept:
    """Age at a sample of a message, in ns: between the stamps where both have one, else between arrivals."""
    return stamp - of_stamp if stamp != 0 and of_stamp != 0 else arrival - of_arrival


@cython.final
cdef class Topic:
    """Messages of one topic that may still be chosen, and how far it got."""

    cdef str name
    cdef Py_ssize_t width, head, count, room, most, most_over_a_jump, remembered
    cdef Message** kept  # (room,): those from head on may be chosen; the others are free
    cdef list _blocks
    cdef Closed* closed  # a ring of (remembered,)
    cdef Py_ssize_t closed_at, closed_count
    cdef Py_ssize_t[::1] where  # place of each value in [x; u; s]
    cdef instant_t[::1] max_age  # ns, of each value
    cdef double[::1] steady, previous  # for angles: the branch to begin with, and the last value
    cdef list limited  # place, least, greatest, ignored values
    cdef list unwrap
    cdef bint header, clock_has_stamps
    cdef Forgotten forgotten[2]  # of messages with arrivals, and with stamps
    cdef bint heard[2]
    cdef instant_t last[2]  # instant of the last message without a stamp, and with one
    cdef bint left_by_stamp
    cdef instant_t left  # the instant from which its time last stepped back
    cdef bint ahead  # its time has stepped back, the clock's perhaps not yet
    cdef bint behind  # the clock's time has stepped back, its own not yet
    cdef Py_ssize_t leave  # a sample before the step back, by its number, that has chosen `left_one`; 0 for none
    cdef Message left_one

    def __cinit__(self, signals, str name, max_age):
        self.name = name
        self.where = np.array(signals.on(name), dtype=np.intp)
        self.width = len(self.where)
        here = [signals[i] for i in self.where]
        self.max_age = np.array([max_age[i] for i in self.where], dtype=np.longlong)
        self.steady = np.array([signals.branch(i) for i in self.where], dtype=np.float64)
        self.previous = self.steady.copy()
        self.unwrap = [(i, turn) for i, signal in enumerate(here) if (turn := FieldPath(signal.field).unwrap)]
        self.limited = [
            (i, *(signal.valid or (-math.inf, math.inf)), np.array(sorted(signal.ignored), dtype=np.float64))
            for i, signal in enumerate(here)
            if signal.valid is not None or signal.ignore
        ]
        self.header, self.clock_has_stamps = (signals.time[topic] == "header" for topic in (name, signals.clock))
        self.most, self.most_over_a_jump, self.remembered = BUFFERED_MESSAGES, KEPT_OVER_A_JUMP, REMEMBERED_SAMPLES
        self._blocks = []
        self.closed = <Closed*>calloc(self.remembered, sizeof(Closed))
        if self.closed == NULL:
            raise MemoryError
        self.grow(16)
        self.left_one.values = self.kept[self.room - 1].values  # the last one is never taken
        self.room -= 1

    def __dealloc__(self):
        free(self.kept)
        free(self.closed)

    cdef int grow(self, Py_ssize_t more) except -1:
        """Room for more messages."""
        numbers, messages = np.zeros((more, 2 * self.width)), np.zeros(more * sizeof(Message), dtype=np.uint8)
        cdef double[:, ::1] values = numbers
        cdef unsigned char[::1] room = messages
        cdef Message** kept = <Message**>realloc(self.kept, (self.room + more) * sizeof(Message*))
        cdef Py_ssize_t i
        if kept == NULL:
            raise MemoryError
        self._blocks += [numbers, messages]
        self.kept = kept
        for i in range(more):
            kept[self.room + i] = <Message*>&room[i * <Py_ssize_t>sizeof(Message)]
            kept[self.room + i].values = &values[i, 0]
        self.room += more
        return 0

    cdef Message* free_one(self) except NULL:
        """Where the next message goes; `append` takes it in."""
        cdef Message** kept = self.kept
        cdef Message* free
        cdef Py_ssize_t i
        if self.head + self.count == self.room:
            if 2 * self.count > self.room:
                self.grow(self.room)
            else:
                for i in range(self.count):
                    free = kept[i]
                    kept[i], kept[self.head + i] = kept[self.head + i], free
                self.head = 0
        return self.kept[self.head + self.count]

    cdef bint steps_back(self, Message* message, instant_t limit) noexcept:
        """Whether a message is more than limit before the last one on the same clock."""
        cdef bint stamped = message.stamp != 0
        cdef instant_t instant = message.stamp if stamped else message.arrival
        cdef instant_t last = self.last[stamped] if self.heard[stamped] else instant
        self.heard[stamped], self.last[stamped] = True, instant
        if instant < last - limit:
            self.left_by_stamp, self.left = stamped, last
            return True
        if self.ahead and self.left_by_stamp == stamped and instant >= self.left:
            self.ahead = False  # single messages had stepped back, and no time
        return False

    cdef bint came_late(self, Message* message) noexcept:
        """Whether a closed sample would have chosen this message."""
        cdef Py_ssize_t i
        cdef Closed* at
        cdef instant_t behind
        for i in range(self.closed_count):
            at = &self.closed[(self.closed_at - 1 - i + self.remembered) % self.remembered]
            behind = behind_of(at.arrival, at.stamp, message.arrival, message.stamp)
            if behind < 0:
                break
            if not at.chose or behind <= behind_of(at.arrival, at.stamp, at.chosen_arrival, at.chosen_stamp):
                return True
        return False

    cdef Message* choose(self, Message* sample, Py_ssize_t number) noexcept:
        """The message with the greatest stamp at or before a sample, ties to the latest arrival.

        NULL where there is none, or it has been forgotten.
        """
        cdef instant_t age = 2**63 - 1, behind, instant, since
        cdef Message* chosen = NULL
        cdef Message* message
        cdef Py_ssize_t i
        if self.leave and self.leave == number:
            return &self.left_one
        for i in range(self.head, self.head + self.count):
            message = self.kept[i]
            behind = behind_of(sample.arrival, sample.stamp, message.arrival, message.stamp)
            if 0 <= behind <= age:
                chosen, age = message, behind
        for i in range(2):
            if self.forgotten[i].some:
                instant = sample.stamp if i else sample.arrival
                since = instant - self.forgotten[i].last
                if (i and not instant) or (self.forgotten[i].first <= instant and (since if since > 0 else 0) < age):
                    return NULL  # perhaps; there may be nothing between the sample and what would be chosen
        return chosen

    cdef int append(self, Message* sample, Py_ssize_t number) except -1:
        """Take in the message of `free_one`, which may be chosen; sample is the open one."""
        cdef Message* held
        cdef Message* message
        cdef Forgotten* gone
        cdef Py_ssize_t i, k, half = self.count // 2, first = self.head
        cdef instant_t instant
        if self.count >= self.most:
            held = NULL if sample == NULL else self.choose(sample, number)
            for k in range(first, first + half):
                message = self.kept[k]
                if sample == NULL or behind_of(sample.arrival, sample.stamp, message.arrival, message.stamp) < 0:
                    i = self.clock_has_stamps and message.stamp != 0
                    instant, gone = message.stamp if i else message.arrival, &self.forgotten[i]
                    gone.first = instant if not gone.some or instant < gone.first else gone.first
                    gone.last = instant if not gone.some or instant > gone.last else gone.last
                    gone.some = True
            self.head += half
            self.count -= half
            for k in range(first, first + half):
                if self.kept[k] == held:
                    self.head -= 1
                    self.count += 1
                    self.kept[k], self.kept[self.head] = self.kept[self.head], held
                    break
        self.count += 1
        return 0

    cdef void start_anew(self, Message* sample, Py_ssize_t number, Message* message) noexcept:
        """The topic's time has stepped back to a message, as in a bag that is played again; the last pass is forgotten.

        The open sample may be of that pass too, where the clock has not stepped back yet: not since the topic last did,
        or there is the topic that never followed, and the sample is nearer to the time that it leaves only now.
        """
        cdef instant_t instant, apart, behind
        cdef Message* held
        cdef double* values
        if self.behind and sample != NULL:
            instant = sample.stamp if self.left_by_stamp else sample.arrival
            apart = instant - self.left
            behind = behind_of(sample.arrival, sample.stamp, message.arrival, message.stamp)
            if not (self.left_by_stamp and not instant) and abs(apart) < abs(behind):
                self.behind = False
        held = NULL if sample == NULL or self.behind else self.choose(sample, number)
        self.leave = 0
        if held != NULL:
            self.leave = number
            if held != &self.left_one:
                values = self.left_one.values
                self.left_one = held[0]
                self.left_one.values = values
                memcpy(values, held.values, 2 * self.width * sizeof(double))
        if self.count:  # the message takes the place of the first: where it lies stays
            self.kept[self.head], self.kept[self.head + self.count] = message, self.kept[self.head]
        self.count = self.closed_count = 0
        self.forgotten[0].some = self.forgotten[1].some = False
        self.ahead, self.behind = not self.behind, False
        self.previous[:] = self.steady

    cdef void close(self, Message* sample, Message* chosen, bint reset) noexcept:
        """Forget what no later sample can choose.

        Where time jumps, later samples are earlier: what came before them on the new time is kept.
        """
        cdef bint jumps = reset or (self.ahead and self.count < self.most_over_a_jump)
        cdef Message** kept = self.kept
        cdef Message* message
        cdef Closed* at
        cdef Forgotten* gone
        cdef Py_ssize_t i, count
        cdef instant_t instant
        if self.leave:  # what is chosen is not among those kept
            jumps, self.leave = True, 0
        if chosen != NULL and not jumps:
            while kept[self.head] != chosen and (  # most often this is all
                behind_of(sample.arrival, sample.stamp, kept[self.head].arrival, kept[self.head].stamp) >= 0
            ):
                self.head += 1
                self.count -= 1
            count = 0
            for i in range(self.head, self.head + self.count):
                message = kept[i]
                if message == chosen or (
                    behind_of(sample.arrival, sample.stamp, message.arrival, message.stamp) < 0
                ):
                    kept[i], kept[self.head + count] = kept[self.head + count], message
                    count += 1
            self.count = count
            for i in range(2):  # of the time before a sample that has chosen what was forgotten matters no longer
                gone, instant = &self.forgotten[i], sample.stamp if i else sample.arrival
                if gone.some and not (i and not instant):
                    gone.some = gone.last > instant
                    gone.first = gone.first if gone.first > instant + 1 else instant + 1
        if reset:
            self.behind = not self.ahead
            self.ahead = False
            self.closed_count = 0  # nothing of this pass can be late for a sample of the one before
            return
        at = &self.closed[self.closed_at]
        at.arrival, at.stamp, at.chose = sample.arrival, sample.stamp, chosen != NULL
        if chosen != NULL:
            at.chosen_arrival, at.chosen_stamp = chosen.arrival, chosen.stamp
        self.closed_at = (self.closed_at + 1) % self.remembered
        self.closed_count += self.closed_count < self.remembered

    cdef void turn(self, double* values):
        """Angles, each on the branch nearest to the one before."""
        cdef Py_ssize_t i
        cdef double turn
        for i, turn in self.unwrap:
            if isfinite(values[i]):
                values[i] += turn * (rint((self.previous[i] - values[i]) / turn) + 0.0)
                if isfinite(values[i]):
                    self.previous[i] = values[i]
