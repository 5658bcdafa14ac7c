"""Measurements against peers and against the machine's own floors; `python -m bench` prints every table."""
