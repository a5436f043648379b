/* Course: messages that come in order and complete, from serialised message to published verdict.

   On a robot at work nearly every message is of this kind, and Python takes several times as long over one of them
   as the middleware takes to deliver it. What is done here is what MessageReader, Sampler, EnvelopeMonitor and
   NamedVector do, with the same operations on each number in the same order, for the same bits. Whatever is not of
   this kind, and whatever turns the alarm, is refused and leaves no trace here: course.py then hands everything over
   to them, and they go on.

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
#define TOPICS 64
#define LONGEST 10000  /* window and delays; handed to and fro at every stop */
#define TWO_PI 6.283185307179586

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
    Py_ssize_t angles; /* values that are unwrapped */
    int64_t *angle;
    double *previous; /* of each value */
    /* layout of its messages */
    Py_ssize_t size;
    unsigned char *mask, *want; /* both `size` long */
    int stamped;
    int64_t stamp_at;
    int64_t *parts; /* numbers that each value is made of */
    int64_t *offset; /* of each number */
    char *code;      /* as in Python's struct */
    PyObject *derived; /* tuple of what makes a value of its parts; None: its one part is it */
    /* what it says of the enable condition; `conditional` 0: nothing */
    int conditional, relation, holds;
    int64_t condition_at;
    char condition_code;
    double condition_value, condition_said; /* the limit, and what the field said last; NaN: nothing since it goes on */
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
    Py_ssize_t place, delay; /* of a control in z; its value of so many samples before counts */
    double *line;            /* the last `delay` values */
    Py_ssize_t at;           /* of the oldest */
    double raw;              /* of the sample that closes */
} Delayed;

typedef struct {
    PyObject_HEAD
    Py_ssize_t n, size, topics; /* size = n + m */
    int several; /* states are on several topics: a sample is judged when it closes */
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
    Delayed *delayed;
    Py_ssize_t delays;
    /* the alarm: the verdicts it looks at, and how many of them are violations */
    unsigned char *counted, *recent, *inside; /* n, window, n */
    Py_ssize_t needed, window, filled, oldest, violating;
    int64_t from; /* instant from which verdicts count */
    int alarm, said; /* of the window; what ~/violation says */
    /* the open sample, and the one before with what became of it */
    int running, cut; /* cut: a sample, since it goes on */
    Instant open, judged_at;
    double open_dt;
    double *open_values; /* of the clock topic's count */
    double *fresh, *z, *before, *closing, *zn, *size_of, *x_next; /* size; z is [x; u] of the last transition,
                                                                     before that of the last closed sample */
    double *centre, *half, *low, *high;
    double dt;
    /* counts since the last `counts` */
    int64_t samples, outside, *violations; /* n */
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
    PyMem_Free(topic->parts);
    PyMem_Free(topic->offset);
    PyMem_Free(topic->code);
    Py_CLEAR(topic->derived);
    topic->mask = topic->want = NULL;
    topic->parts = topic->offset = NULL;
    topic->code = NULL;
    topic->size = -1;
}

static int
Course_traverse(Course *self, visitproc visit, void *arg)
{
    for (Py_ssize_t k = 0; self->topic && k < self->topics; k++)
        Py_VISIT(self->topic[k].derived);
    for (int i = 0; i < OUTPUTS; i++)
        Py_VISIT(self->send[i]);
    Py_VISIT(self->arrival);
    Py_VISIT(self->failure);
    Py_VISIT(self->log);
    return 0;
}

/* What sends leads back to the node that has this: only a collector can tell that nobody else does. */
static int
Course_clear(Course *self)
{
    self->running = 0;
    for (Py_ssize_t k = 0; self->topic && k < self->topics; k++)
        forget_layout(&self->topic[k]);
    for (int i = 0; i < OUTPUTS; i++)
        Py_CLEAR(self->send[i]);
    Py_CLEAR(self->arrival);
    Py_CLEAR(self->failure);
    Py_CLEAR(self->log);
    return 0;
}

static void
Course_dealloc(Course *self)
{
    PyObject_GC_UnTrack(self);
    Course_clear(self);
    for (Py_ssize_t k = 0; self->topic && k < self->topics; k++) {
        Topic *topic = &self->topic[k];
        PyMem_Free(topic->where);
        PyMem_Free(topic->max_age);
        PyMem_Free(topic->angle);
        PyMem_Free(topic->previous);
        PyMem_Free(topic->instant);
        PyMem_Free(topic->values);
    }
    PyMem_Free(self->topic);
    for (Py_ssize_t i = 0; self->delayed && i < self->delays; i++)
        PyMem_Free(self->delayed[i].line);
    PyMem_Free(self->delayed);
    for (int i = 0; i < self->blocks; i++)
        PyMem_Free(self->memory[i]);
    Py_TYPE(self)->tp_free((PyObject *)self);
}

/* --- making one ----------------------------------------------------------------------------------------------- */

static int
Course_init(Course *self, PyObject *args, PyObject *kwargs)
{
    static char *names[] = {"n", "size", "rows", "point", "margin", "max_gap", "min_step",
                            "usual_step", "usual_dt", "plain", "marked", "topics", "several", "delays",
                            "counted", "alarm", NULL};
    PyObject *rows, *point, *plain, *marked, *topics, *delays, *counted;
    long long max_gap, min_step, usual_step;
    const char *from;
    Py_ssize_t n, size;
    if (self->topic) {
        PyErr_SetString(PyExc_RuntimeError, "made already");
        return -1;
    }
    if (!PyArg_ParseTupleAndKeywords(
            args, kwargs, "nnOOdLLLdO!O!O!pO!O(nn)", names, &n, &size, &rows, &point, &self->margin,
            &max_gap, &min_step, &usual_step, &self->usual_dt, &PyTuple_Type, &plain, &PyTuple_Type, &marked,
            &PyTuple_Type, &topics, &self->several, &PyTuple_Type, &delays, &counted, &self->needed, &self->window))
        return -1;
    if (n < 1 || size < n || size > 100000 || PyTuple_GET_SIZE(topics) < 1 || PyTuple_GET_SIZE(topics) > TOPICS) {
        PyErr_SetString(PyExc_ValueError, "n, size or topics out of range");
        return -1;
    }
    if (self->needed < 1 || self->window < self->needed || self->window > LONGEST) {
        PyErr_SetString(PyExc_ValueError, "the alarm's rule is out of range");
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
    if (!(self->z = block(self, sizeof(double) * (size_t)(6 * size + 5 * n))))
        return -1;
    self->before = self->z + size;
    self->closing = self->before + size;
    self->zn = self->closing + size;
    self->size_of = self->zn + size;
    self->fresh = self->size_of + size;
    self->x_next = self->fresh + size;
    self->centre = self->x_next + n;
    self->half = self->centre + n;
    self->low = self->half + n;
    self->high = self->low + n;
    if (numbers(counted, n, 1, "counted", &from))
        return -1;
    if (!(self->counted = block(self, (size_t)(2 * n + self->window))))
        return -1;
    memcpy(self->counted, from, (size_t)n);
    self->inside = self->counted + n;
    self->recent = self->inside + n;
    if (!(self->violations = block(self, sizeof(int64_t) * (size_t)n)))
        return -1;
    if (!(self->delayed = PyMem_Calloc((size_t)PyTuple_GET_SIZE(delays) + 1, sizeof(Delayed)))) {
        PyErr_NoMemory();
        return -1;
    }
    for (; self->delays < PyTuple_GET_SIZE(delays); self->delays++) {
        Delayed *one = &self->delayed[self->delays];
        if (!PyArg_ParseTuple(PyTuple_GET_ITEM(delays, self->delays), "nn", &one->place, &one->delay))
            return -1;
        if (one->place < n || one->place >= size || one->delay < 1 || one->delay > LONGEST)
            goto misplaced;
        if (!(one->line = PyMem_Calloc((size_t)one->delay, sizeof(double)))) {
            PyErr_NoMemory();
            return -1;
        }
    }
    self->topics = PyTuple_GET_SIZE(topics);
    if (!(self->topic = PyMem_Calloc((size_t)self->topics, sizeof(Topic)))) {
        PyErr_NoMemory();
        return -1;
    }
    for (Py_ssize_t k = 0; k < self->topics; k++) {
        Topic *topic = &self->topic[k];
        PyObject *where, *max_age, *angles;
        if (!PyArg_ParseTuple(PyTuple_GET_ITEM(topics, k), "pSSS", &topic->header, &where, &max_age, &angles))
            return -1;
        topic->count = PyBytes_GET_SIZE(where) / 8;
        if (topic->count > size)
            goto misplaced;
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
        topic->angles = PyBytes_GET_SIZE(angles) / 8;
        if (numbers(angles, topic->angles, 8, "angles", &from))
            return -1;
        if (!(topic->angle = copied(from, (size_t)topic->angles * 8)))
            return -1;
        for (Py_ssize_t i = 0; i < topic->angles; i++)
            if (topic->angle[i] < 0 || topic->angle[i] >= topic->count)
                goto misplaced;
        if (!(topic->previous = PyMem_Calloc((size_t)topic->count + 1, sizeof(double)))) {
            PyErr_NoMemory();
            return -1;
        }
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

/* A number at its place in a message, as Python's struct and float() have it. */
static double
number_at(const char *at, char code)
{
#define AS(kind) { kind value; memcpy(&value, at, sizeof value); return (double)value; }
    switch (code) {
    case 'd': AS(double)
    case 'f': AS(float)
    case 'b': AS(int8_t)
    case 'B': AS(uint8_t)
    case 'h': AS(int16_t)
    case 'H': AS(uint16_t)
    case 'i': AS(int32_t)
    case 'I': AS(uint32_t)
    case 'q': AS(int64_t)
    default: AS(uint64_t)
    }
#undef AS
}

/* Bytes that a number takes; 0 for a code that is none. */
static int
width_of(char code)
{
    switch (code) {
    case 'd': case 'q': case 'Q': return 8;
    case 'f': case 'i': case 'I': return 4;
    case 'h': case 'H': return 2;
    case 'b': case 'B': return 1;
    default: return 0;
    }
}

/* A value made of several numbers; -1 with an exception where that fails. */
static int
derive(PyObject *made_by, const char *data, const int64_t *offset, const char *code, Py_ssize_t parts, double *value)
{
    PyObject *made, *list = PyList_New(parts);
    for (Py_ssize_t i = 0; list && i < parts; i++) {
        PyObject *part = PyFloat_FromDouble(number_at(data + offset[i], code[i]));
        if (!part)
            Py_CLEAR(list);
        else
            PyList_SET_ITEM(list, i, part);
    }
    if (!list)
        return -1;
    made = PyObject_CallOneArg(made_by, list);
    Py_DECREF(list);
    if (!made)
        return -1;
    *value = PyFloat_AsDouble(made);
    Py_DECREF(made);
    return *value == -1.0 && PyErr_Occurred() ? -1 : 0;
}

/* Whether the enable condition holds by this value; -1 where it is not a number. */
static int
holds(const Topic *topic, double value)
{
    double other = topic->condition_value;
    if (value != value)
        return -1;
    switch (topic->relation) {
    case 0: return value == other;
    case 1: return value != other;
    case 2: return value <= other;
    case 3: return value >= other;
    case 4: return value < other;
    default: return value > other;
    }
}

/* Whether it fits; then its instant and numbers. -1 with an exception where Python's part of it fails. */
static int
read_message(Topic *topic, const char *data, Py_ssize_t size, int64_t arrival, Instant *instant, double *values)
{
    const unsigned char *bytes = (const unsigned char *)data;
    const int64_t *offset = topic->offset;
    const char *code = topic->code;
    unsigned char differs = 0;
    int64_t stamp = 0;
    if (size != topic->size)
        return 0;
    for (Py_ssize_t i = 0; i < size; i++)
        differs |= (unsigned char)((bytes[i] & topic->mask[i]) ^ topic->want[i]);
    if (differs)
        return 0;
    if (topic->conditional) {
        double said = number_at(data + topic->condition_at, topic->condition_code);
        if (holds(topic, said) != topic->holds)
            return 0;
        topic->condition_said = said;
    }
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
        PyObject *made_by = PyTuple_GET_ITEM(topic->derived, i);
        if (made_by == Py_None)
            values[i] = number_at(data + *offset, *code);
        else if (derive(made_by, data, offset, code, topic->parts[i], &values[i]))
            return -1;
        offset += topic->parts[i];
        code += topic->parts[i];
        if (!isfinite(values[i]))
            return 0;
    }
    for (Py_ssize_t i = 0; i < topic->angles; i++) {
        double *value = &values[topic->angle[i]];
        /* + 0.0: a turn of -0 is one of 0, as it is for Python's whole numbers */
        *value += TWO_PI * (rint((topic->previous[topic->angle[i]] - *value) / TWO_PI) + 0.0);
        if (!isfinite(*value))
            return 0;
    }
    return 1;
}

/* Its angles are those that the next ones are held against. */
static void
unwrapped(Topic *topic, const double *values)
{
    for (Py_ssize_t i = 0; i < topic->angles; i++)
        topic->previous[topic->angle[i]] = values[topic->angle[i]];
}

/* Age of a message at a sample, ns. */
static int64_t
behind(const Instant *sample, const Instant *message)
{
    if (sample->stamp && message->stamp)
        return sample->stamp - message->stamp;
    return sample->arrival - message->arrival;
}

/* Take a message of another topic than the clock's; 0 where it is not of the usual kind, -1 with an exception. */
static int
keep(Topic *topic, const char *data, Py_ssize_t size, int64_t arrival, double now, int64_t max_gap)
{
    Instant instant;
    double *values;
    int64_t when;
    int fits;
    if (topic->kept == KEPT)
        return 0;
    values = topic->values + topic->kept * topic->count;
    if ((fits = read_message(topic, data, size, arrival, &instant, values)) != 1)
        return fits;
    when = instant.stamp ? instant.stamp : instant.arrival;
    if (topic->has_last && when < topic->last - max_gap)
        return 0; /* its time has stepped back */
    if (topic->has_closed) {
        if (behind(&topic->closed[(topic->closings + CLOSED - 1) % CLOSED], &instant) >= 0)
            return 0; /* perhaps too late for a closed sample */
    }
    unwrapped(topic, values);
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

/* The same with NaN for what is missing or too old. */
static void
put_known(const Topic *topic, Py_ssize_t chosen, const Instant *sample, double *z)
{
    int64_t age = chosen < 0 ? 0 : behind(sample, &topic->instant[chosen]);
    for (Py_ssize_t i = 0; i < topic->count; i++)
        z[topic->where[i]] = chosen < 0 || age > topic->max_age[i] ? NAN : topic->values[chosen * topic->count + i];
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
        return copysign(INFINITY, difference); /* no NaN: bounds and sample are finite */
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
    const double one = 1.0;
    PyObject *message = message_of(self->marked, self->marked_size, t_ns, &at);
    for (Py_ssize_t i = 0; message && i < self->n; i++) {
        if (!self->inside[i])
            memcpy(at + self->marked_at + 8 * i, &one, 8);
        if (outside)
            memcpy(at + self->marks_at + 8 * i, &one, 8);
    }
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

/* Bounds, sample, utilisation and flags as little-endian doubles, with the instant and whether z was outside of the
   domain. */
static PyObject *
verdict(Course *self, int64_t t_ns, int outside)
{
    PyObject *packed[5];
    char *at[5];
    for (int k = 0; k < 5; k++) {
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
    for (Py_ssize_t i = 0; i < self->n; i++) {
        double value = !self->inside[i];
        memcpy(at[4] + 8 * i, &value, 8);
    }
    return Py_BuildValue("(LNNNNNN)", (long long)t_ns, PyBool_FromLong(outside), packed[0], packed[1], packed[2],
                         packed[3], packed[4]);
}

/* What becomes of the alarm's window by a verdict: how many of it are then violations, or -1 where the alarm turns. */
static Py_ssize_t
violating(const Course *self, int armed, int hit)
{
    Py_ssize_t found = 0;
    if (armed) {
        found = self->violating + hit;
        if (self->filled == self->window)
            found -= self->recent[self->oldest];
    }
    return (found >= self->needed) == self->alarm ? found : -1;
}

static void
count(Course *self, int armed, int hit, Py_ssize_t violating)
{
    self->violating = violating;
    if (!armed) {
        self->filled = self->oldest = 0;
        return;
    }
    if (self->filled == self->window)
        self->oldest = (self->oldest + 1) % self->window;
    else
        self->filled++;
    self->recent[(self->oldest + self->filled - 1) % self->window] = (unsigned char)hit;
}

/* Judge the sample that this message opens, or closes where states are on several topics, and publish; 0, and nothing
   has changed, where it is not of the usual kind. The message's numbers stand in self->fresh. */
static int
judge(Course *self, const Instant *opened, double now, PyObject *data)
{
    Topic *clock = &self->topic[0];
    Py_ssize_t n = self->n, chosen[TOPICS], hits;
    int64_t step = when(opened) - when(&self->open), t_ns;
    double dt = (double)step * 1e-9;
    const double *before = self->several ? self->before : self->closing;
    int outside = 0, made = 0, hit = 0, armed;
    PyObject *message[OUTPUTS], *(*send)[OUTPUTS] = &self->send;
    int kind[OUTPUTS];
    if (step <= 0 || step < self->min_step || step > self->max_gap)
        return 0;
    /* z = [x; u] of the sample that this one closes */
    for (Py_ssize_t i = 0; i < clock->count; i++)
        self->closing[clock->where[i]] = self->open_values[i];
    for (Py_ssize_t k = 1; k < self->topics; k++) {
        chosen[k] = choose(&self->topic[k], &self->open);
        if (!put(&self->topic[k], chosen[k], &self->open, self->closing))
            return 0;
    }
    for (Py_ssize_t i = 0; i < self->delays; i++) {
        Delayed *one = &self->delayed[i];
        one->raw = self->closing[one->place];
        self->closing[one->place] = one->line[one->at];
        if (!isfinite(one->line[one->at]))
            return 0;
    }
    if (self->several)
        memcpy(self->x_next, self->closing, sizeof(double) * (size_t)n);
    else
        for (Py_ssize_t i = 0; i < clock->count; i++)
            if (clock->where[i] < n)
                self->x_next[clock->where[i]] = self->fresh[i];
    t_ns = when(self->several ? &self->open : opened);
    bound(self, before, self->several ? self->open_dt : dt);
    for (Py_ssize_t i = 0; i < n; i++) {
        double x_next = (self->x_next[i] - self->steady[i]) / self->scale[i];
        if (!isfinite(self->low[i]) || !isfinite(self->high[i]) || !isfinite(x_next))
            return 0;
        self->inside[i] = self->low[i] <= x_next && x_next <= self->high[i];
        hit |= self->counted[i] && !self->inside[i];
    }
    for (Py_ssize_t j = 0; j < self->size; j++)
        outside |= (self->zn[j] < self->least[j]) | (self->zn[j] > self->greatest[j]);
    armed = t_ns >= self->from;
    if ((hits = violating(self, armed, hit)) < 0)
        return 0;
    /* from here on it is done */
    count(self, armed, hit, hits);
    for (Py_ssize_t i = 0; i < n; i++)
        self->violations[i] += !self->inside[i];
    for (Py_ssize_t k = 1; k < self->topics; k++)
        close_sample(&self->topic[k], &self->open, chosen[k]);
    for (Py_ssize_t i = 0; i < self->delays; i++) {
        Delayed *one = &self->delayed[i];
        one->line[one->at] = one->raw;
        one->at = (one->at + 1) % one->delay;
    }
    unwrapped(clock, self->fresh);
    self->judged_at = self->several ? self->open : *opened;
    self->dt = self->several ? self->open_dt : dt;
    memcpy(self->z, before, sizeof(double) * (size_t)self->size);
    memcpy(self->before, self->closing, sizeof(double) * (size_t)self->size);
    memcpy(self->open_values, self->fresh, sizeof(double) * (size_t)clock->count);
    self->open = *opened;
    self->open_dt = dt;
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
        for (Py_ssize_t k = 1; k < self->topics; k++)
            put_known(&self->topic[k], choose(&self->topic[k], opened), opened, z);
        for (Py_ssize_t i = 0; i < self->delays; i++)
            z[self->delayed[i].place] = self->delayed[i].line[self->delayed[i].at];
        for (Py_ssize_t j = 0; known && j < self->size; j++)
            known = isfinite(z[j]);
        if (known) {
            bound(self, z, self->usual_dt);
            for (int k = PREDICTED_LOWER; k <= PREDICTED_UPPER; k++) {
                if (!(*send)[k])
                    continue;
                message[made] = vector(self, k, when(opened) + self->usual_step, NULL);
                kind[made] = k;
                if (!message[made])
                    goto failed;
                made++;
            }
        }
    }
    if ((*send)[VIOLATION]) {
        if (!(message[made] = PyBytes_FromStringAndSize(self->said ? "\x00\x01\x00\x00\x01" : "\x00\x01\x00\x00\x00",
                                                        5)))
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

/* Leave a message to Python, which meets the same error; one that is to end the process goes on. */
static PyObject *
refuse(Course *self)
{
    self->running = 0;
    if (!PyErr_ExceptionMatches(PyExc_Exception))
        return NULL;
    PyErr_Clear();
    Py_RETURN_FALSE;
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
    if (!times(self, &arrival, &now))
        return refuse(self);
    done = read_message(&self->topic[0], PyBytes_AS_STRING(data), PyBytes_GET_SIZE(data), arrival, &opened, self->fresh);
    if (done < 0)
        return refuse(self);
    if (done)
        done = judge(self, &opened, now, data);
    if (done != 1)
        self->running = 0;
    if (done < 0 && !PyErr_ExceptionMatches(PyExc_Exception))
        return NULL;
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
    int taken;
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
    if (!times(self, &arrival, &now))
        return refuse(self);
    taken = keep(&self->topic[k], PyBytes_AS_STRING(args[1]), PyBytes_GET_SIZE(args[1]), arrival, now, self->max_gap);
    if (taken < 0)
        return refuse(self);
    self->running = taken;
    if (taken && note(self, k, args[1], arrival, now, NULL))
        return NULL;
    return PyBool_FromLong(taken);
}

/* --- from and to Python --------------------------------------------------------------------------------------- */

/* All of a ring of numbers, from its oldest on. */
static PyObject *
ring(const double *from, Py_ssize_t count, Py_ssize_t oldest)
{
    PyObject *list = PyList_New(count);
    for (Py_ssize_t i = 0; list && i < count; i++) {
        PyObject *value = PyFloat_FromDouble(from[(oldest + i) % count]);
        if (!value)
            Py_CLEAR(list);
        else
            PyList_SET_ITEM(list, i, value);
    }
    return list;
}

static PyObject *
doubles(const double *from, Py_ssize_t count)
{
    return ring(from, count, 0);
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

/* What tells how a topic's messages look: mask, want, place of the stamp or -1, then of all values how many numbers each
   is made of, the numbers' places and codes, what makes values of them, and the enable condition or None. */
static int
take_layout(Topic *topic, PyObject *layout)
{
    PyObject *mask, *want, *parts, *offset, *code, *derived, *condition;
    const char *masks, *wants, *from;
    long long stamp_at;
    Py_ssize_t numbers_in_all = 0, size;
    if (!PyArg_ParseTuple(layout, "SSLSSSO!O", &mask, &want, &stamp_at, &parts, &offset, &code, &PyTuple_Type, &derived,
                          &condition))
        return -1;
    forget_layout(topic);
    size = PyBytes_GET_SIZE(mask);
    masks = PyBytes_AS_STRING(mask);
    if (numbers(want, size, 1, "want", &wants))
        return -1;
    if (!(topic->mask = copied(masks, (size_t)size)) || !(topic->want = copied(wants, (size_t)size)))
        return -1;
    topic->stamped = stamp_at >= 0;
    topic->stamp_at = stamp_at;
    if (topic->stamped && stamp_at > size - 8)
        goto misplaced;
    if (numbers(parts, topic->count, 8, "parts", &from) || !(topic->parts = copied(from, (size_t)topic->count * 8)))
        return -1;
    if (PyTuple_GET_SIZE(derived) != topic->count) {
        PyErr_SetString(PyExc_ValueError, "what makes values of numbers is missing");
        return -1;
    }
    for (Py_ssize_t i = 0; i < topic->count; i++) {
        if (topic->parts[i] < 0 || topic->parts[i] > size ||
            (PyTuple_GET_ITEM(derived, i) == Py_None && topic->parts[i] != 1))
            goto misplaced;
        numbers_in_all += topic->parts[i];
    }
    if (numbers(offset, numbers_in_all, 8, "offset", &from) ||
        !(topic->offset = copied(from, (size_t)numbers_in_all * 8)))
        return -1;
    if (numbers(code, numbers_in_all, 1, "code", &from) || !(topic->code = copied(from, (size_t)numbers_in_all)))
        return -1;
    for (Py_ssize_t i = 0; i < numbers_in_all; i++) {
        int width = width_of(topic->code[i]);
        if (!width || topic->offset[i] < 4 || topic->offset[i] > size - width)
            goto misplaced;
    }
    topic->conditional = condition != Py_None;
    topic->condition_said = NAN;
    if (topic->conditional) {
        long long at;
        int letter, width;
        if (!PyArg_ParseTuple(condition, "LCidp", &at, &letter, &topic->relation, &topic->condition_value,
                              &topic->holds))
            return -1;
        topic->condition_code = (char)letter;
        topic->condition_at = at;
        width = letter < 128 ? width_of((char)letter) : 0;
        if (!width || at < 4 || at > size - width)
            goto misplaced;
    }
    topic->derived = Py_NewRef(derived);
    topic->size = size;
    return 0;
misplaced:
    PyErr_SetString(PyExc_ValueError, "a number stands outside of its message");
    return -1;
}

/* Of another topic than the clock's: the instant of its last message, the last closed sample, messages that may be
   chosen. */
static int
take_messages(Topic *topic, PyObject *last, PyObject *closed, PyObject *kept)
{
    long long stamp, arrival;
    PyObject *values;
    const char *from;
    Py_ssize_t count = topic->count;
    topic->has_last = last != Py_None;
    if (topic->has_last && (topic->last = PyLong_AsLongLong(last)) == -1 && PyErr_Occurred())
        return -1;
    topic->has_closed = closed != Py_None;
    if (topic->has_closed) {
        Instant *place = &topic->closed[CLOSED - 1]; /* where the one before the first is looked for */
        if (!PyArg_ParseTuple(closed, "LL", &stamp, &arrival))
            return -1;
        place->stamp = stamp;
        place->arrival = arrival;
    }
    if (PyList_GET_SIZE(kept) > KEPT / 2) {
        PyErr_SetString(PyExc_ValueError, "too many messages are kept");
        return -1;
    }
    topic->kept = 0;
    for (Py_ssize_t i = 0; i < PyList_GET_SIZE(kept); i++) {
        if (!PyArg_ParseTuple(PyList_GET_ITEM(kept, i), "LLS", &stamp, &arrival, &values) ||
            numbers(values, count, 8, "values", &from))
            return -1;
        topic->instant[i].stamp = stamp;
        topic->instant[i].arrival = arrival;
        memcpy(topic->values + i * count, from, (size_t)count * 8);
        topic->kept++;
    }
    return 0;
}

static int
take_delays(Course *self, PyObject *lines)
{
    const char *from;
    if (PyTuple_GET_SIZE(lines) != self->delays) {
        PyErr_SetString(PyExc_ValueError, "a delay is missing");
        return -1;
    }
    for (Py_ssize_t i = 0; i < self->delays; i++) {
        Delayed *one = &self->delayed[i];
        if (numbers(PyTuple_GET_ITEM(lines, i), one->delay, 8, "line", &from))
            return -1;
        memcpy(one->line, from, (size_t)one->delay * 8);
        one->at = 0;
    }
    return 0;
}

static PyObject *
Course_resume(Course *self, PyObject *args)
{
    PyObject *values, *before, *topics, *lines, *recent, *tells, *log;
    long long stamp, arrival, from_ns;
    const char *from;
    Topic *clock = &self->topic[0];
    if (!self->open_values) {
        PyErr_SetString(PyExc_RuntimeError, "not made yet");
        return NULL;
    }
    self->running = 0;
    if (!PyArg_ParseTuple(args, "(LLSdS)O!O!(SppL)OO", &stamp, &arrival, &values, &self->open_dt, &before,
                          &PyTuple_Type, &topics, &PyTuple_Type, &lines, &recent, &self->alarm, &self->said, &from_ns,
                          &tells, &log))
        return NULL;
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
    if (numbers(before, self->size, 8, "before", &from))
        return NULL;
    memcpy(self->before, from, (size_t)self->size * 8);
    if (PyTuple_GET_SIZE(topics) != self->topics) {
        PyErr_SetString(PyExc_ValueError, "a topic is missing");
        return NULL;
    }
    for (Py_ssize_t k = 0; k < self->topics; k++) {
        Topic *topic = &self->topic[k];
        PyObject *layout, *last, *closed, *kept, *previous;
        if (!PyArg_ParseTuple(PyTuple_GET_ITEM(topics, k), "O!OOO!O", &PyTuple_Type, &layout, &last, &closed,
                              &PyList_Type, &kept, &previous))
            return NULL;
        if (take_layout(topic, layout) || numbers(previous, topic->angles, 8, "previous", &from))
            return NULL;
        for (Py_ssize_t i = 0; i < topic->angles; i++)
            memcpy(&topic->previous[topic->angle[i]], from + 8 * i, 8);
        topic->closings = 0;
        if (k && take_messages(topic, last, closed, kept))
            return NULL;
    }
    if (take_delays(self, lines))
        return NULL;
    if (PyBytes_GET_SIZE(recent) > self->window) {
        PyErr_SetString(PyExc_ValueError, "more verdicts than the alarm looks at");
        return NULL;
    }
    self->oldest = self->violating = 0;
    self->filled = PyBytes_GET_SIZE(recent);
    for (Py_ssize_t i = 0; i < self->filled; i++) {
        self->recent[i] = PyBytes_AS_STRING(recent)[i] != 0;
        self->violating += self->recent[i];
    }
    self->from = from_ns;
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
    counts = Py_BuildValue("(LLy#ddN)", (long long)self->samples, (long long)self->outside, (char *)self->violations,
                           8 * self->n, self->judged, self->has_published ? self->published : 0.0, topics);
    if (counts) {
        memset(self->violations, 0, sizeof(int64_t) * (size_t)self->n);
        self->samples = self->outside = 0;
        self->has_published = 0;
        for (Py_ssize_t k = 0; k < self->topics; k++)
            self->topic[k].received = 0;
    }
    return counts;
}

/* Of one topic: the instant of its last message, messages that may be chosen, samples closed beside what they chose,
   the angles that the next ones are held against, and what the enable condition's field said last, or None. */
static PyObject *
tell_topic(const Topic *topic)
{
    PyObject *kept = PyList_New(0), *closed = PyList_New(0), *previous = PyList_New(0), *last, *said, *one = NULL;
    for (Py_ssize_t i = 0; kept && i < topic->kept; i++) {
        PyObject *message = Py_BuildValue("(NN)", told(&topic->instant[i]),
                                          doubles(topic->values + i * topic->count, topic->count));
        if (!message || PyList_Append(kept, message))
            Py_CLEAR(kept);
        Py_XDECREF(message);
    }
    for (Py_ssize_t i = topic->closings > CLOSED ? topic->closings - CLOSED : 0; closed && i < topic->closings; i++) {
        PyObject *pair = Py_BuildValue("(NN)", told(&topic->closed[i % CLOSED]), told(&topic->chosen[i % CLOSED]));
        if (!pair || PyList_Append(closed, pair))
            Py_CLEAR(closed);
        Py_XDECREF(pair);
    }
    for (Py_ssize_t i = 0; previous && i < topic->angles; i++) {
        PyObject *value = PyFloat_FromDouble(topic->previous[topic->angle[i]]);
        if (!value || PyList_Append(previous, value))
            Py_CLEAR(previous);
        Py_XDECREF(value);
    }
    last = topic->has_last ? PyLong_FromLongLong(topic->last) : Py_NewRef(Py_None);
    said = topic->conditional && !isnan(topic->condition_said) ? PyFloat_FromDouble(topic->condition_said)
                                                               : Py_NewRef(Py_None);
    if (last && kept && closed && previous && said)
        one = PyTuple_Pack(5, last, kept, closed, previous, said);
    Py_XDECREF(last);
    Py_XDECREF(said);
    Py_XDECREF(kept);
    Py_XDECREF(closed);
    Py_XDECREF(previous);
    return one;
}

static PyObject *
tell_delays(const Course *self)
{
    PyObject *lines = PyTuple_New(self->delays);
    for (Py_ssize_t i = 0; lines && i < self->delays; i++) {
        const Delayed *one = &self->delayed[i];
        PyObject *line = ring(one->line, one->delay, one->at);
        if (!line)
            Py_CLEAR(lines);
        else
            PyTuple_SET_ITEM(lines, i, line);
    }
    return lines;
}

/* The verdicts that the alarm looks at, oldest first. */
static PyObject *
tell_window(const Course *self)
{
    PyObject *window = PyBytes_FromStringAndSize(NULL, self->filled);
    for (Py_ssize_t i = 0; window && i < self->filled; i++)
        PyBytes_AS_STRING(window)[i] = (char)self->recent[(self->oldest + i) % self->window];
    return window;
}

static PyObject *
Course_pause(Course *self, PyObject *Py_UNUSED(ignored))
{
    PyObject *topics = PyTuple_New(self->topics), *failure;
    for (Py_ssize_t k = 0; topics && k < self->topics; k++) {
        PyObject *one = tell_topic(&self->topic[k]);
        if (!one)
            Py_CLEAR(topics);
        else
            PyTuple_SET_ITEM(topics, k, one);
    }
    if (!topics)
        return NULL;
    self->running = 0;
    Py_CLEAR(self->arrival);
    Py_CLEAR(self->log);
    failure = self->failure ? self->failure : Py_NewRef(Py_None);
    self->failure = NULL;
    if (!self->cut)
        return Py_BuildValue("(NON)", topics, Py_None, failure);
    return Py_BuildValue("(N(NNdNNNLLdNN)N)", topics, told(&self->open),
                         doubles(self->open_values, self->topic[0].count), self->open_dt,
                         doubles(self->before, self->size), tell_delays(self), tell_window(self),
                         (long long)when(&self->judged_at), (long long)self->judged_at.arrival, self->dt,
                         doubles(self->z, self->size), doubles(self->x_next, self->n), failure);
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
    .tp_traverse = (traverseproc)Course_traverse,
    .tp_clear = (inquiry)Course_clear,
    .tp_flags = Py_TPFLAGS_DEFAULT | Py_TPFLAGS_HAVE_GC,
    .tp_doc = "Messages that come in order and complete.",
    .tp_methods = methods,
    .tp_init = (initproc)Course_init,
    .tp_new = PyType_GenericNew,
};

static struct PyModuleDef module = {
    PyModuleDef_HEAD_INIT, "_course", "Messages that come in order and complete.", -1, NULL,
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
