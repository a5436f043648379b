"""What a file or a parameter may state at most: beyond it times pass 64 bits, and squares overflow."""

LONGEST_S = 9e9
"""s; 2^63 ns are 9.2e9 s."""
LARGEST = 1e50
"""Magnitude of a number in recorded units or in 1/s, and of a scale or its inverse: squares of ratios stay finite."""
