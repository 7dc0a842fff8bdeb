"""Solves the same problems by other libraries, each in a process of its own.

The code of that process, `worker.py`, `problem.py` and the modules `with_...`, needs numpy and that library alone.
"""
