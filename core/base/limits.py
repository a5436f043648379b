# Copyright 2026 uncertain-lti maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except in compliance with
# the License. You may obtain a copy of the License at http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software distributed under the License is distributed on an
# "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the
# specific language governing permissions and limitations under the License.

"""What a file or a parameter may state at most: beyond it times pass 64 bits, and squares overflow."""

LONGEST_S = 9e9
"""s; 2^63 ns are 9.2e9 s."""
LARGEST = 1e50
"""Magnitude of a number in recorded units or in 1/s, and of a scale or its inverse: squares of ratios stay finite."""
