"""Proposal: what a person should start from, a signals file from a recording.

May import every room above: base to validation.
"""
