"""Recordings: files in and out, from MCAP blocks and CDR layouts to columns of numbers, and copies.

May import base and signals.
"""
