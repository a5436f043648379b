"""Sampling: streams of messages into samples, by one rule offline and live; transients and operating points.

May import base, signals and recordings.
"""
