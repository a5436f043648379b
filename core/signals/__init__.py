"""Signals: which field of which topic is which state or control, and how a field is written.

May import base.
"""
