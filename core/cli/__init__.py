"""Command line: one command a file.

May import every room.
"""
