/* Course: messages that come in order, complete and within their bounds, from serialised message to published verdict.

   On a robot at work nearly every message is of this kind, and Python takes several times as long over one of them
   as the middleware takes to deliver it. What is done here is what MessageReader, Sampler, EnvelopeMonitor and
   NamedVector do, with the same operations on each number in the same order, for the same bits. Whatever is not of
   this kind is refused and leaves no trace here: course.py then hands everything over to them, and they go on.

   No numpy, and no header but Python's. To be compiled without contraction of a * b + c, which would change bits. */

#define PY_SSIZE_T_CLEAN
#include <Python.h>
#include <math.h>
#include <stdint.h>
#include <string.h>
#include <time.h>

#ifndef SOURCE
#define SOURCE 0 /* checksum of this file, from setup.py */
#endif
#define KEPT 512       /* messages of a topic that wait for a later sample */
#define CLOSED 100     /* REMEMBERED_SAMPLES of the sampler */
#define FUTURE 1000000000LL

enum { FLAGS, LOWER, UPPER, STATE, UTILISATION, PREDICTED_LOWER, PREDICTED_UPPER, VIOLATION, OUTPUTS };

typedef struct {
    int64_t stamp, arrival; /* stamp 0: goes by arrival */
} Instant;

typedef struct {
    /* what is fixed */
    Py_ssize_t count; /* of values */
    int header;
    int64_t *where;   /* place of each value in z */
    int64_t *max_age; /* ns, of each value */
    /* layout of its messages */
    Py_ssize_t size;
    unsigned char *mask, *want; /* both `size` long */
    int stamped;
    int64_t stamp_at;
    int64_t *offset;
    char *code; /* 'f' or 'd' */
    /* messages that may be chosen; not of the clock topic */
    Py_ssize_t kept;
    Instant *instant; /* KEPT */
    double *values;   /* KEPT x count */
    int has_last, has_closed;
    int64_t last;
    Instant closed[CLOSED], chosen[CLOSED];
    Py_ssize_t closings; /* since the start */
    /* counts */
    int64_t received;
    double heard;
} Topic;

typedef struct {
    PyObject_HEAD
    Py_ssize_t n, size, topics; /* size = n + m */
    double *nominal, *spread;   /* [A B], [dA dB]: n x size */
    double *c, *dc, *v;         /* n */
    double *steady, *scale, *least, *greatest; /* size */
    double margin, usual_dt;
    int64_t max_gap, min_step, usual_step; /* usual_step < 0: nothing is predicted */
    Topic *topic;
    char *plain, *marked; /* messages with zeros for stamp and numbers */
    Py_ssize_t plain_size, marked_size, plain_at, marked_at, marks_at;
    PyObject *send[OUTPUTS]; /* NULL: nobody listens */
    int listening;
    /* the open sample, and the one before with what became of it */
    int running, cut; /* cut: a sample, since it goes on */
    Instant open;
    double *open_values;   /* of the clock topic's count */
    double *fresh, *z, *closing, *zn, *size_of, *x_next; /* size; z is [x; u] of the last transition */
    double *centre, *half, *low, *high;
    double dt;
    /* counts since the last `counts` */
    int64_t samples, outside;
    double judged, published;
    int has_published;
    PyObject *arrival; /* tells the time of arrival, ns; NULL: the computer's clock does */
    PyObject *failure; /* what an output raised */
    PyObject *log;     /* list of what came and what was said of it, for snapshots; NULL: none is kept */
    void *memory[32];
    int blocks;
} Course;

/* --- memory ------------------------------------------------------------------------------------------------- */

static void *
block(Course *self, size_t bytes)
{
    void *found;
    if (self->blocks == 32) {
        PyErr_SetString(PyExc_RuntimeError, "too many blocks");
        return NULL;
    }
    found = PyMem_Calloc(bytes ? bytes : 1, 1);
    if (!found) {
        PyErr_NoMemory();
        return NULL;
    }
    return self->memory[self->blocks++] = found;
}

static void *
copied(const void *from, size_t bytes)
{
    void *found = PyMem_Malloc(bytes ? bytes : 1);
    if (!found)
        return PyErr_NoMemory();
    memcpy(found, from, bytes);
    return found;
}

static int
numbers(PyObject *given, Py_ssize_t count, Py_ssize_t width, const char *name, const char **out)
{
    if (!PyBytes_Check(given) || PyBytes_GET_SIZE(given) != count * width) {
        PyErr_Format(PyExc_ValueError, "%s must be bytes of %zd numbers", name, count);
        return -1;
    }
    *out = PyBytes_AS_STRING(given);
    return 0;
}

static void
forget_layout(Topic *topic)
{
    PyMem_Free(topic->mask);
    PyMem_Free(topic->want);
    PyMem_Free(topic->offset);
    PyMem_Free(topic->code);
    topic->mask = topic->want = NULL;
    topic->offset = NULL;
    topic->code = NULL;
    topic->size = -1;
}

static void
Course_dealloc(Course *self)
{
    for (Py_ssize_t k = 0; self->topic && k < self->topics; k++) {
        Topic *topic = &self->topic[k];
        forget_layout(topic);
        PyMem_Free(topic->where);
        PyMem_Free(topic->max_age);
        PyMem_Free(topic->instant);
        PyMem_Free(topic->values);
    }
    PyMem_Free(self->topic);
    for (int i = 0; i < self->blocks; i++)
        PyMem_Free(self->memory[i]);
    for (int i = 0; i < OUTPUTS; i++)
        Py_XDECREF(self->send[i]);
    Py_XDECREF(self->arrival);
    Py_XDECREF(self->failure);
    Py_XDECREF(self->log);
    Py_TYPE(self)->tp_free((PyObject *)self);
}

/* --- making one ----------------------------------------------------------------------------------------------- */

static int
Course_init(Course *self, PyObject *args, PyObject *kwargs)
{
    static char *names[] = {"n", "size", "rows", "point", "margin", "max_gap", "min_step",
                            "usual_step", "usual_dt", "plain", "marked", "topics", NULL};
    PyObject *rows, *point, *plain, *marked, *topics;
    long long max_gap, min_step, usual_step;
    const char *from;
    Py_ssize_t n, size;
    if (self->topic) {
        PyErr_SetString(PyExc_RuntimeError, "made already");
        return -1;
    }
    if (!PyArg_ParseTupleAndKeywords(
            args, kwargs, "nnOOdLLLdO!O!O!", names, &n, &size, &rows, &point, &self->margin,
            &max_gap, &min_step, &usual_step, &self->usual_dt, &PyTuple_Type, &plain, &PyTuple_Type, &marked,
            &PyTuple_Type, &topics))
        return -1;
    if (n < 1 || size < n || size > 100000 || PyTuple_GET_SIZE(topics) < 1) {
        PyErr_SetString(PyExc_ValueError, "n, size or topics out of range");
        return -1;
    }
    self->n = n;
    self->size = size;
    self->max_gap = max_gap;
    self->min_step = min_step;
    self->usual_step = usual_step;
    /* nominal, spread (n x size each), c, dc, v (n each) */
    if (numbers(rows, 2 * n * size + 3 * n, 8, "rows", &from))
        return -1;
    if (!(self->nominal = block(self, (size_t)PyBytes_GET_SIZE(rows))))
        return -1;
    memcpy(self->nominal, from, (size_t)PyBytes_GET_SIZE(rows));
    self->spread = self->nominal + n * size;
    self->c = self->spread + n * size;
    self->dc = self->c + n;
    self->v = self->dc + n;
    /* steady, scale, least, greatest (size each) */
    if (numbers(point, 4 * size, 8, "point", &from))
        return -1;
    if (!(self->steady = block(self, (size_t)PyBytes_GET_SIZE(point))))
        return -1;
    memcpy(self->steady, from, (size_t)PyBytes_GET_SIZE(point));
    self->scale = self->steady + size;
    self->least = self->scale + size;
    self->greatest = self->least + size;
    {
        const char *text;
        Py_ssize_t length;
        if (!PyArg_ParseTuple(plain, "y#n", &text, &length, &self->plain_at))
            return -1;
        if (length < 12 || self->plain_at < 12 || self->plain_at + 8 * n > length)
            goto misplaced;
        if (!(self->plain = block(self, (size_t)length)))
            return -1;
        memcpy(self->plain, text, (size_t)length);
        self->plain_size = length;
        if (!PyArg_ParseTuple(marked, "y#nn", &text, &length, &self->marked_at, &self->marks_at))
            return -1;
        if (length < 12 || self->marked_at < 12 || self->marked_at + 8 * n > length || self->marks_at < 12 ||
            self->marks_at + 8 * n > length)
            goto misplaced;
        if (!(self->marked = block(self, (size_t)length)))
            return -1;
        memcpy(self->marked, text, (size_t)length);
        self->marked_size = length;
    }
    if (!(self->z = block(self, sizeof(double) * (size_t)(5 * size + 5 * n))))
        return -1;
    self->closing = self->z + size;
    self->zn = self->closing + size;
    self->size_of = self->zn + size;
    self->fresh = self->size_of + size;
    self->x_next = self->fresh + size;
    self->centre = self->x_next + n;
    self->half = self->centre + n;
    self->low = self->half + n;
    self->high = self->low + n;
    self->topics = PyTuple_GET_SIZE(topics);
    if (!(self->topic = PyMem_Calloc((size_t)self->topics, sizeof(Topic)))) {
        PyErr_NoMemory();
        return -1;
    }
    for (Py_ssize_t k = 0; k < self->topics; k++) {
        Topic *topic = &self->topic[k];
        PyObject *where, *max_age;
        if (!PyArg_ParseTuple(PyTuple_GET_ITEM(topics, k), "pSS", &topic->header, &where, &max_age))
            return -1;
        topic->count = PyBytes_GET_SIZE(where) / 8;
        if (numbers(where, topic->count, 8, "where", &from))
            return -1;
        if (!(topic->where = copied(from, (size_t)topic->count * 8)))
            return -1;
        if (numbers(max_age, topic->count, 8, "max_age", &from))
            return -1;
        if (!(topic->max_age = copied(from, (size_t)topic->count * 8)))
            return -1;
        for (Py_ssize_t i = 0; i < topic->count; i++)
            if (topic->where[i] < 0 || topic->where[i] >= size)
                goto misplaced;
        topic->size = -1;
        if (k && (!(topic->instant = PyMem_Calloc(KEPT, sizeof(Instant))) ||
                  !(topic->values = PyMem_Calloc((size_t)(KEPT * (topic->count + 1)), sizeof(double))))) {
            PyErr_NoMemory();
            return -1;
        }
    }
    if (!(self->open_values = block(self, sizeof(double) * (size_t)(self->topic[0].count + 1))))
        return -1;
    return 0;
misplaced:
    PyErr_SetString(PyExc_ValueError, "a number would stand outside of its message or vector");
    return -1;
}

/* --- reading a message ---------------------------------------------------------------------------------------- */

/* Whether it fits; then its instant and numbers. */
static int
read_message(const Topic *topic, const char *data, Py_ssize_t size, int64_t arrival, Instant *instant, double *values)
{
    const unsigned char *bytes = (const unsigned char *)data;
    unsigned char differs = 0;
    int64_t stamp = 0;
    if (size != topic->size)
        return 0;
    for (Py_ssize_t i = 0; i < size; i++)
        differs |= (unsigned char)((bytes[i] & topic->mask[i]) ^ topic->want[i]);
    if (differs)
        return 0;
    if (topic->stamped) {
        int32_t seconds;
        uint32_t nanoseconds;
        memcpy(&seconds, data + topic->stamp_at, 4);
        memcpy(&nanoseconds, data + topic->stamp_at + 4, 4);
        stamp = (int64_t)seconds * 1000000000LL + nanoseconds;
        if (stamp > arrival + FUTURE)
            return 0;
    }
    if (topic->header && stamp <= 0)
        return 0;
    instant->stamp = topic->header ? stamp : 0;
    instant->arrival = arrival;
    for (Py_ssize_t i = 0; i < topic->count; i++) {
        if (topic->code[i] == 'd') {
            memcpy(&values[i], data + topic->offset[i], 8);
        }
        else {
            float value;
            memcpy(&value, data + topic->offset[i], 4);
            values[i] = value;
        }
        if (!isfinite(values[i]))
            return 0;
    }
    return 1;
}

/* Age of a message at a sample, ns. */
static int64_t
behind(const Instant *sample, const Instant *message)
{
    if (sample->stamp && message->stamp)
        return sample->stamp - message->stamp;
    return sample->arrival - message->arrival;
}

/* Take a message of another topic than the clock's; 0 where it is not of the usual kind. */
static int
keep(Topic *topic, const char *data, Py_ssize_t size, int64_t arrival, double now, int64_t max_gap)
{
    Instant instant;
    double *values;
    int64_t when;
    if (topic->kept == KEPT)
        return 0;
    values = topic->values + topic->kept * topic->count;
    if (!read_message(topic, data, size, arrival, &instant, values))
        return 0;
    when = instant.stamp ? instant.stamp : instant.arrival;
    if (topic->has_last && when < topic->last - max_gap)
        return 0; /* its time has stepped back */
    if (topic->has_closed) {
        if (behind(&topic->closed[(topic->closings + CLOSED - 1) % CLOSED], &instant) >= 0)
            return 0; /* perhaps too late for a closed sample */
    }
    topic->has_last = 1;
    topic->last = when;
    topic->instant[topic->kept++] = instant;
    topic->received++;
    topic->heard = now;
    return 1;
}

/* Which of the messages kept counts at a sample: the greatest stamp not after it, ties to the latest; -1 for none. */
static Py_ssize_t
choose(const Topic *topic, const Instant *sample)
{
    Py_ssize_t chosen = -1;
    int64_t age = INT64_MAX;
    for (Py_ssize_t k = 0; k < topic->kept; k++) {
        int64_t old = behind(sample, &topic->instant[k]);
        if (0 <= old && old <= age) {
            chosen = k;
            age = old;
        }
    }
    return chosen;
}

/* Put what a topic says at a sample into z; 0 where something is missing, too old or not finite. */
static int
put(const Topic *topic, Py_ssize_t chosen, const Instant *sample, double *z)
{
    int64_t age;
    const double *values;
    if (chosen < 0)
        return 0;
    age = behind(sample, &topic->instant[chosen]);
    values = topic->values + chosen * topic->count;
    for (Py_ssize_t i = 0; i < topic->count; i++) {
        if (age > topic->max_age[i] || !isfinite(values[i]))
            return 0;
        z[topic->where[i]] = values[i];
    }
    return 1;
}

/* Forget what no later sample can choose, as the sampler does when a sample closes. */
static void
close_sample(Topic *topic, const Instant *sample, Py_ssize_t chosen)
{
    Py_ssize_t left = 0;
    Instant instant = topic->instant[chosen];
    for (Py_ssize_t k = 0; k < topic->kept; k++) {
        if (k != chosen && behind(sample, &topic->instant[k]) >= 0)
            continue;
        if (left != k) {
            topic->instant[left] = topic->instant[k];
            memmove(topic->values + left * topic->count, topic->values + k * topic->count,
                    sizeof(double) * (size_t)topic->count);
        }
        left++;
    }
    topic->kept = left;
    topic->closed[topic->closings % CLOSED] = *sample;
    topic->chosen[topic->closings % CLOSED] = instant;
    topic->closings++;
    topic->has_closed = 1;
}

/* --- bounds --------------------------------------------------------------------------------------------------- */

/* Normalised centre and half-width one step after z, and the bounds; Leibov (2006), eqs. (6)(7) with additive terms.
   One row after the other with sums from the left, as EnvelopeMonitor has them; rows four at a time, as each sum
   waits for its own last term. */
static void
bound(Course *self, const double *z, double dt)
{
    Py_ssize_t n = self->n, size = self->size;
    double *zn = self->zn, *size_of = self->size_of;
    for (Py_ssize_t j = 0; j < size; j++) {
        zn[j] = (z[j] - self->steady[j]) / self->scale[j];
        size_of[j] = fabs(zn[j]);
    }
    for (Py_ssize_t i = 0; i < n; i += 4) {
        const double *a[4], *d[4];
        double rate[4], spread[4];
        Py_ssize_t rows = n - i < 4 ? n - i : 4;
        for (Py_ssize_t r = 0; r < 4; r++) {
            Py_ssize_t row = i + (r < rows ? r : 0);
            a[r] = self->nominal + row * size;
            d[r] = self->spread + row * size;
            rate[r] = a[r][0] * zn[0];
            spread[r] = d[r][0] * size_of[0];
        }
        for (Py_ssize_t j = 1; j < size; j++)
            for (Py_ssize_t r = 0; r < 4; r++) {
                rate[r] += a[r][j] * zn[j];
                spread[r] += d[r][j] * size_of[j];
            }
        for (Py_ssize_t r = 0; r < rows; r++) {
            double centre = (rate[r] + self->c[i + r]) * dt + zn[i + r];
            double half = (spread[r] + self->dc[i + r]) * dt + self->v[i + r];
            double judged = self->margin == 1.0 ? half : half * self->margin;
            self->centre[i + r] = centre;
            self->half[i + r] = half;
            self->low[i + r] = centre - judged;
            self->high[i + r] = centre + judged;
        }
    }
}

/* --- publishing ----------------------------------------------------------------------------------------------- */

static PyObject *
message_of(const char *pattern, Py_ssize_t size, int64_t t_ns, char **at)
{
    int64_t seconds = t_ns / 1000000000LL, nanoseconds = t_ns % 1000000000LL;
    int32_t whole;
    uint32_t rest;
    PyObject *message = PyBytes_FromStringAndSize(pattern, size);
    if (!message)
        return NULL;
    if (nanoseconds < 0) {
        nanoseconds += 1000000000LL;
        seconds--;
    }
    whole = (int32_t)(seconds > INT32_MAX ? INT32_MAX : seconds < INT32_MIN ? INT32_MIN : seconds);
    rest = (uint32_t)nanoseconds;
    *at = PyBytes_AS_STRING(message);
    memcpy(*at + 4, &whole, 4);
    memcpy(*at + 8, &rest, 4);
    return message;
}

static double
utilisation(double difference, double half)
{
    if (difference == 0.0)
        return 0.0;
    if (half == 0.0)
        return copysign(INFINITY, difference);
    return difference / half;
}

/* Element i of bounds, sample or utilisation, in recorded units. */
static double
number(const Course *self, int kind, Py_ssize_t i, const double *sample)
{
    switch (kind) {
    case LOWER:
    case PREDICTED_LOWER:
        return self->steady[i] + self->scale[i] * self->low[i];
    case UPPER:
    case PREDICTED_UPPER:
        return self->steady[i] + self->scale[i] * self->high[i];
    case STATE:
        return sample[i];
    default:
        return utilisation((sample[i] - self->steady[i]) / self->scale[i] - self->centre[i], self->half[i]);
    }
}

static PyObject *
vector(Course *self, int kind, int64_t t_ns, const double *sample)
{
    char *at;
    PyObject *message = message_of(self->plain, self->plain_size, t_ns, &at);
    for (Py_ssize_t i = 0; message && i < self->n; i++) {
        double value = number(self, kind, i, sample);
        memcpy(at + self->plain_at + 8 * i, &value, 8);
    }
    return message;
}

static PyObject *
flags(Course *self, int64_t t_ns, int outside)
{
    char *at;
    double mark = outside;
    PyObject *message = message_of(self->marked, self->marked_size, t_ns, &at);
    if (message)
        for (Py_ssize_t i = 0; outside && i < self->n; i++)
            memcpy(at + self->marks_at + 8 * i, &mark, 8);
    return message;
}

/* --- a sample ------------------------------------------------------------------------------------------------- */

static int64_t
when(const Instant *instant)
{
    return instant->stamp ? instant->stamp : instant->arrival;
}

/* When a message that is here now arrived, ns, and a steady time in s; 0 with an exception where that fails. */
static int
times(Course *self, int64_t *arrival, double *now)
{
    struct timespec time;
    if (self->arrival) {
        PyObject *told = PyObject_CallNoArgs(self->arrival);
        if (!told)
            return 0;
        *arrival = PyLong_AsLongLong(told);
        Py_DECREF(told);
        if (*arrival == -1 && PyErr_Occurred())
            return 0;
    }
    else {
        clock_gettime(CLOCK_REALTIME, &time);
        *arrival = (int64_t)time.tv_sec * 1000000000LL + time.tv_nsec;
    }
    clock_gettime(CLOCK_MONOTONIC, &time);
    *now = (double)time.tv_sec + (double)time.tv_nsec * 1e-9;
    return 1;
}

/* Note a message, and of a clock message what it decided; -1 with an exception. */
static int
note(Course *self, Py_ssize_t k, PyObject *data, int64_t arrival, double now, PyObject *said)
{
    PyObject *entry;
    int done;
    if (!self->log) {
        Py_XDECREF(said);
        return 0;
    }
    entry = Py_BuildValue("(dLnON)", now, (long long)arrival, k, data, said ? said : Py_NewRef(Py_None));
    if (!entry)
        return -1;
    done = PyList_Append(self->log, entry);
    Py_DECREF(entry);
    return done;
}

/* Bounds, sample and utilisation as little-endian doubles, with the instant and whether z was outside of the domain. */
static PyObject *
verdict(Course *self, int64_t t_ns, int outside)
{
    PyObject *packed[4];
    char *at[4];
    for (int k = 0; k < 4; k++) {
        if (!(packed[k] = PyBytes_FromStringAndSize(NULL, 8 * self->n))) {
            while (k)
                Py_DECREF(packed[--k]);
            return NULL;
        }
        at[k] = PyBytes_AS_STRING(packed[k]);
    }
    for (Py_ssize_t i = 0; i < self->n; i++)
        for (int k = 0; k < 4; k++) {
            double value = number(self, LOWER + k, i, self->x_next);
            memcpy(at[k] + 8 * i, &value, 8);
        }
    return Py_BuildValue("(LNNNNN)", (long long)t_ns, PyBool_FromLong(outside), packed[0], packed[1], packed[2],
                         packed[3]);
}

/* Judge the sample that this message opens and publish; 0, and nothing has changed, where it is not of the usual kind.
   The message's numbers stand in self->fresh. */
static int
judge(Course *self, const Instant *opened, double now, PyObject *data)
{
    Topic *clock = &self->topic[0];
    Py_ssize_t n = self->n, chosen[64];
    int64_t step = when(opened) - when(&self->open), t_ns = when(opened);
    double dt = (double)step * 1e-9;
    int outside = 0, made = 0;
    PyObject *message[OUTPUTS], *(*send)[OUTPUTS] = &self->send;
    int kind[OUTPUTS];
    if (step <= 0 || step < self->min_step || step > self->max_gap || self->topics > 64)
        return 0;
    /* z = [x; u] of the sample that this one closes */
    for (Py_ssize_t i = 0; i < clock->count; i++)
        self->closing[clock->where[i]] = self->open_values[i];
    for (Py_ssize_t k = 1; k < self->topics; k++) {
        chosen[k] = choose(&self->topic[k], &self->open);
        if (!put(&self->topic[k], chosen[k], &self->open, self->closing))
            return 0;
    }
    for (Py_ssize_t i = 0; i < clock->count; i++)
        if (clock->where[i] < n)
            self->x_next[clock->where[i]] = self->fresh[i];
    bound(self, self->closing, dt);
    for (Py_ssize_t i = 0; i < n; i++) {
        double x_next = (self->x_next[i] - self->steady[i]) / self->scale[i];
        if (!(self->low[i] <= x_next && x_next <= self->high[i]))
            return 0;
    }
    for (Py_ssize_t j = 0; j < self->size; j++)
        outside |= (self->zn[j] < self->least[j]) | (self->zn[j] > self->greatest[j]);
    /* from here on it is done */
    for (Py_ssize_t k = 1; k < self->topics; k++)
        close_sample(&self->topic[k], &self->open, chosen[k]);
    memcpy(self->z, self->closing, sizeof(double) * (size_t)self->size);
    memcpy(self->open_values, self->fresh, sizeof(double) * (size_t)clock->count);
    self->open = *opened;
    self->dt = dt;
    self->cut = 1;
    self->samples++;
    self->outside += outside;
    self->judged = clock->heard = now;
    clock->received++;
    if (self->log) {
        PyObject *said = verdict(self, t_ns, outside);
        if (!said || note(self, 0, data, opened->arrival, now, said))
            return -1;
    }
    if (!self->listening)
        return 1;
    for (int k = FLAGS; k <= UTILISATION; k++) {
        if (!(*send)[k])
            continue;
        message[made] = k == FLAGS ? flags(self, t_ns, outside) : vector(self, k, t_ns, self->x_next);
        kind[made] = k;
        if (!message[made])
            goto failed;
        made++;
    }
    if (((*send)[PREDICTED_LOWER] || (*send)[PREDICTED_UPPER]) && self->usual_step >= 0) {
        double *z = self->fresh; /* size long; the message's numbers are in open_values by now */
        int known = 1;
        for (Py_ssize_t i = 0; i < clock->count; i++)
            z[clock->where[i]] = self->open_values[i];
        for (Py_ssize_t k = 1; known && k < self->topics; k++)
            known = put(&self->topic[k], choose(&self->topic[k], opened), opened, z);
        if (known) {
            bound(self, z, self->usual_dt);
            for (int k = PREDICTED_LOWER; k <= PREDICTED_UPPER; k++) {
                if (!(*send)[k])
                    continue;
                message[made] = vector(self, k, t_ns + self->usual_step, NULL);
                kind[made] = k;
                if (!message[made])
                    goto failed;
                made++;
            }
        }
    }
    if ((*send)[VIOLATION]) {
        if (!(message[made] = PyBytes_FromStringAndSize("\x00\x01\x00\x00\x00", 5)))
            goto failed;
        kind[made++] = VIOLATION;
        self->published = now;
        self->has_published = 1;
    }
    for (int k = 0; k < made; k++) {
        /* held: what is sent may be told to stop while it is sent */
        PyObject *done, *to = Py_XNewRef((*send)[kind[k]]);
        if (to) {
            done = PyObject_CallOneArg(to, message[k]);
            Py_DECREF(to);
            if (!done) {
                made -= k;
                memmove(message, message + k, sizeof(PyObject *) * (size_t)made);
                goto failed;
            }
            Py_DECREF(done);
        }
        Py_DECREF(message[k]);
    }
    return 1;
failed:
    while (made)
        Py_DECREF(message[--made]);
    return -1;
}

static PyObject *
Course_sample(Course *self, PyObject *data)
{
    Instant opened;
    int64_t arrival;
    double now;
    int done;
    if (!PyBytes_Check(data)) {
        PyErr_SetString(PyExc_TypeError, "a serialised message is bytes");
        return NULL;
    }
    if (!self->running)
        Py_RETURN_FALSE;
    if (!times(self, &arrival, &now)) {
        if (!PyErr_ExceptionMatches(PyExc_Exception))
            return NULL;
        PyErr_Clear(); /* whoever takes the message meets the same */
        self->running = 0;
        Py_RETURN_FALSE;
    }
    done = read_message(&self->topic[0], PyBytes_AS_STRING(data), PyBytes_GET_SIZE(data), arrival, &opened, self->fresh);
    if (done)
        done = judge(self, &opened, now, data);
    if (done != 1)
        self->running = 0;
    if (done < 0) { /* the sample is judged all the same */
        PyObject *type, *value, *trace;
        PyErr_Fetch(&type, &value, &trace);
        PyErr_NormalizeException(&type, &value, &trace);
        if (value && trace)
            PyException_SetTraceback(value, trace);
        Py_XDECREF(type);
        Py_XDECREF(trace);
        Py_XSETREF(self->failure, value);
    }
    return PyBool_FromLong(done);
}

static PyObject *
Course_other(Course *self, PyObject *const *args, Py_ssize_t given)
{
    Py_ssize_t k;
    int64_t arrival;
    double now;
    if (given != 2 || !PyBytes_Check(args[1])) {
        PyErr_SetString(PyExc_TypeError, "a topic's number and a serialised message are wanted");
        return NULL;
    }
    if ((k = PyLong_AsSsize_t(args[0])) == -1 && PyErr_Occurred())
        return NULL;
    if (k < 1 || k >= self->topics) {
        PyErr_SetString(PyExc_IndexError, "no such topic");
        return NULL;
    }
    if (!self->running)
        Py_RETURN_FALSE;
    if (!times(self, &arrival, &now)) {
        if (!PyErr_ExceptionMatches(PyExc_Exception))
            return NULL;
        PyErr_Clear(); /* whoever takes the message meets the same */
        self->running = 0;
        Py_RETURN_FALSE;
    }
    self->running = keep(&self->topic[k], PyBytes_AS_STRING(args[1]), PyBytes_GET_SIZE(args[1]), arrival, now,
                         self->max_gap);
    if (self->running && note(self, k, args[1], arrival, now, NULL))
        return NULL;
    return PyBool_FromLong(self->running);
}

/* --- from and to Python --------------------------------------------------------------------------------------- */

static PyObject *
doubles(const double *from, Py_ssize_t count)
{
    PyObject *list = PyList_New(count);
    for (Py_ssize_t i = 0; list && i < count; i++) {
        PyObject *value = PyFloat_FromDouble(from[i]);
        if (!value)
            Py_CLEAR(list);
        else
            PyList_SET_ITEM(list, i, value);
    }
    return list;
}

static PyObject *
told(const Instant *instant)
{
    return Py_BuildValue("(LL)", (long long)instant->stamp, (long long)instant->arrival);
}

static PyObject *
Course_listen(Course *self, PyObject *sends)
{
    if (!PyTuple_Check(sends) || PyTuple_GET_SIZE(sends) != OUTPUTS) {
        PyErr_Format(PyExc_ValueError, "%d outputs are wanted", OUTPUTS);
        return NULL;
    }
    self->listening = 0;
    for (int k = 0; k < OUTPUTS; k++) {
        PyObject *send = PyTuple_GET_ITEM(sends, k);
        Py_XSETREF(self->send[k], send == Py_None ? NULL : Py_NewRef(send));
        self->listening |= send != Py_None;
    }
    Py_RETURN_NONE;
}

static PyObject *
Course_resume(Course *self, PyObject *args)
{
    PyObject *values, *topics, *tells, *log;
    long long stamp, arrival;
    const char *from;
    Topic *clock = &self->topic[0];
    if (!self->open_values) {
        PyErr_SetString(PyExc_RuntimeError, "not made yet");
        return NULL;
    }
    if (!PyArg_ParseTuple(args, "(LLS)O!OO", &stamp, &arrival, &values, &PyTuple_Type, &topics, &tells,
                          &log))
        return NULL;
    self->running = 0;
    if (log != Py_None && !PyList_Check(log)) {
        PyErr_SetString(PyExc_TypeError, "the log is a list");
        return NULL;
    }
    Py_XSETREF(self->log, log == Py_None ? NULL : Py_NewRef(log));
    Py_XSETREF(self->arrival, tells == Py_None ? NULL : Py_NewRef(tells));
    if (numbers(values, clock->count, 8, "values", &from))
        return NULL;
    memcpy(self->open_values, from, (size_t)clock->count * 8);
    self->open.stamp = stamp;
    self->open.arrival = arrival;
    if (PyTuple_GET_SIZE(topics) != self->topics) {
        PyErr_SetString(PyExc_ValueError, "a topic is missing");
        return NULL;
    }
    for (Py_ssize_t k = 0; k < self->topics; k++) {
        Topic *topic = &self->topic[k];
        PyObject *mask, *want, *offset, *code, *last, *closed, *kept;
        Py_ssize_t count = topic->count;
        const char *masks, *wants;
        long long stamp_at;
        if (!PyArg_ParseTuple(PyTuple_GET_ITEM(topics, k), "(SSLSS)OOO!", &mask, &want, &stamp_at, &offset, &code,
                              &last, &closed, &PyList_Type, &kept))
            return NULL;
        forget_layout(topic);
        masks = PyBytes_AS_STRING(mask);
        if (numbers(want, PyBytes_GET_SIZE(mask), 1, "want", &wants))
            return NULL;
        if (!(topic->mask = copied(masks, (size_t)PyBytes_GET_SIZE(mask))) ||
            !(topic->want = copied(wants, (size_t)PyBytes_GET_SIZE(mask))))
            return NULL;
        topic->stamped = stamp_at >= 0;
        topic->stamp_at = stamp_at;
        if (numbers(offset, count, 8, "offset", &from) || !(topic->offset = copied(from, (size_t)count * 8)))
            return NULL;
        if (numbers(code, count, 1, "code", &from) || !(topic->code = copied(from, (size_t)count)))
            return NULL;
        for (Py_ssize_t i = 0; i < count; i++) {
            int width = topic->code[i] == 'd' ? 8 : topic->code[i] == 'f' ? 4 : 0;
            if (!width || topic->offset[i] < 4 || topic->offset[i] + width > PyBytes_GET_SIZE(mask)) {
                PyErr_SetString(PyExc_ValueError, "a number stands outside of its message");
                return NULL;
            }
        }
        if (stamp_at > PyBytes_GET_SIZE(mask) - 8) {
            PyErr_SetString(PyExc_ValueError, "the stamp stands outside of its message");
            return NULL;
        }
        topic->size = PyBytes_GET_SIZE(mask);
        topic->closings = 0;
        if (!k)
            continue;
        topic->has_last = last != Py_None;
        if (topic->has_last && (topic->last = PyLong_AsLongLong(last)) == -1 && PyErr_Occurred())
            return NULL;
        topic->has_closed = closed != Py_None;
        if (topic->has_closed) {
            Instant *place = &topic->closed[CLOSED - 1]; /* where the one before the first is looked for */
            if (!PyArg_ParseTuple(closed, "LL", &stamp, &arrival))
                return NULL;
            place->stamp = stamp;
            place->arrival = arrival;
        }
        if (PyList_GET_SIZE(kept) > KEPT / 2) {
            PyErr_SetString(PyExc_ValueError, "too many messages are kept");
            return NULL;
        }
        topic->kept = 0;
        for (Py_ssize_t i = 0; i < PyList_GET_SIZE(kept); i++) {
            if (!PyArg_ParseTuple(PyList_GET_ITEM(kept, i), "LLS", &stamp, &arrival, &values) ||
                numbers(values, count, 8, "values", &from))
                return NULL;
            topic->instant[i].stamp = stamp;
            topic->instant[i].arrival = arrival;
            memcpy(topic->values + i * count, from, (size_t)count * 8);
            topic->kept++;
        }
    }
    Py_CLEAR(self->failure);
    self->cut = 0;
    self->running = 1;
    Py_RETURN_NONE;
}

static PyObject *
Course_counts(Course *self, PyObject *Py_UNUSED(ignored))
{
    PyObject *topics = PyTuple_New(self->topics), *counts;
    for (Py_ssize_t k = 0; topics && k < self->topics; k++) {
        PyObject *one = Py_BuildValue("(Ld)", (long long)self->topic[k].received, self->topic[k].heard);
        if (!one)
            Py_CLEAR(topics);
        else
            PyTuple_SET_ITEM(topics, k, one);
    }
    if (!topics)
        return NULL;
    counts = Py_BuildValue("(LLddN)", (long long)self->samples, (long long)self->outside, self->judged,
                           self->has_published ? self->published : 0.0, topics);
    if (counts) {
        self->samples = self->outside = 0;
        self->has_published = 0;
        for (Py_ssize_t k = 0; k < self->topics; k++)
            self->topic[k].received = 0;
    }
    return counts;
}

static PyObject *
Course_pause(Course *self, PyObject *Py_UNUSED(ignored))
{
    PyObject *topics = PyTuple_New(self->topics - 1);
    for (Py_ssize_t k = 1; topics && k < self->topics; k++) {
        Topic *topic = &self->topic[k];
        PyObject *kept = PyList_New(0), *closed = PyList_New(0), *one = NULL;
        for (Py_ssize_t i = 0; kept && i < topic->kept; i++) {
            PyObject *message = Py_BuildValue("(NN)", told(&topic->instant[i]),
                                              doubles(topic->values + i * topic->count, topic->count));
            if (!message || PyList_Append(kept, message))
                Py_CLEAR(kept);
            Py_XDECREF(message);
        }
        for (Py_ssize_t i = topic->closings > CLOSED ? topic->closings - CLOSED : 0; closed && i < topic->closings;
             i++) {
            PyObject *pair = Py_BuildValue("(NN)", told(&topic->closed[i % CLOSED]), told(&topic->chosen[i % CLOSED]));
            if (!pair || PyList_Append(closed, pair))
                Py_CLEAR(closed);
            Py_XDECREF(pair);
        }
        if (kept && closed)
            one = topic->has_last ? Py_BuildValue("(LOO)", (long long)topic->last, kept, closed)
                                  : Py_BuildValue("(OOO)", Py_None, kept, closed);
        Py_XDECREF(kept);
        Py_XDECREF(closed);
        if (!one)
            Py_CLEAR(topics);
        else
            PyTuple_SET_ITEM(topics, k - 1, one);
    }
    if (!topics)
        return NULL;
    self->running = 0;
    Py_CLEAR(self->arrival);
    Py_CLEAR(self->log);
    {
        PyObject *failure = self->failure ? self->failure : Py_NewRef(Py_None);
        self->failure = NULL;
        return Py_BuildValue("(NNdNNN)", told(&self->open), doubles(self->open_values, self->topic[0].count), self->dt,
                             self->cut ? doubles(self->z, self->size) : Py_NewRef(Py_None), topics, failure);
    }
}

static PyMethodDef methods[] = {
    {"sample", (PyCFunction)Course_sample, METH_O, "Take a message of the clock topic; False where it was refused."},
    {"other", (PyCFunction)(void (*)(void))Course_other, METH_FASTCALL,
     "Take a message of topic k; False where it was refused."},
    {"listen", (PyCFunction)Course_listen, METH_O, "What sends each output; None where nobody listens."},
    {"resume", (PyCFunction)Course_resume, METH_VARARGS, "Go on from this open sample and these messages."},
    {"counts", (PyCFunction)Course_counts, METH_NOARGS, "What has been counted since the last call."},
    {"pause", (PyCFunction)Course_pause, METH_NOARGS, "Stop, and tell where things stand."},
    {NULL, NULL, 0, NULL},
};

static PyTypeObject CourseType = {
    PyVarObject_HEAD_INIT(NULL, 0).tp_name = "uncertain_lti_ros._course.Course",
    .tp_basicsize = sizeof(Course),
    .tp_dealloc = (destructor)Course_dealloc,
    .tp_flags = Py_TPFLAGS_DEFAULT,
    .tp_doc = "Messages that come in order, complete and within their bounds.",
    .tp_methods = methods,
    .tp_init = (initproc)Course_init,
    .tp_new = PyType_GenericNew,
};

static struct PyModuleDef module = {
    PyModuleDef_HEAD_INIT, "_course", "Messages that come in order, complete and within their bounds.", -1, NULL,
    NULL, NULL, NULL, NULL,
};

PyMODINIT_FUNC
PyInit__course(void)
{
    PyObject *made;
    const uint16_t one = 1;
    if (!*(const unsigned char *)&one) {
        PyErr_SetString(PyExc_ImportError, "messages are little-endian, and this machine is not");
        return NULL;
    }
    if (PyType_Ready(&CourseType) < 0 || !(made = PyModule_Create(&module)))
        return NULL;
    if (PyModule_AddObjectRef(made, "Course", (PyObject *)&CourseType) < 0 ||
        PyModule_AddIntConstant(made, "SOURCE", SOURCE) < 0) {
        Py_DECREF(made);
        return NULL;
    }
    return made;
}
