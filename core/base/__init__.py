"""Base: errors, whole files, progress, English and HTML tables for every room.

Imports nothing of the project.
"""
