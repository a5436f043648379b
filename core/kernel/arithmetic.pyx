# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

# cython: language_level=3, boundscheck=False, wraparound=False, cdivision=True, initializedcheck=False
"""The arithmetic of every verdict, offline and live: one extension, in parts that are compiled together."""

from array import array

import numpy as np

from uncertain_lti.base.arrays import LARGEST

cimport cython
from cpython cimport array as arrays
from libc.math cimport INFINITY, NAN, fabs, fmax, fmin, llrint
from libc.stdlib cimport calloc, free
from libc.string cimport memcpy

cdef double _LARGEST = LARGEST

include "equations.pxi"
include "elements.pxi"
include "tiles.pxi"
include "rows.pxi"
include "passes.pxi"
include "judge.pxi"
include "runs.pxi"
include "repeats.pxi"
include "statistics.pxi"
