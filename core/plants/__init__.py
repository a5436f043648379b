"""Simulated plants for the demo, the examples and the tests."""
