"""Damaged and hostile files for every reader: `python -m tests.stability.fuzz --inputs 100000`, and a short run among the tests."""
