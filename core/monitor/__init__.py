"""Monitor: verdicts, alarm, and a live session without rclpy, from serialised message to serialised verdict.

May import base, signals, recordings, sampling and model.
"""
