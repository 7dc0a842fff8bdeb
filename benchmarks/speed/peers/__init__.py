"""The same problems solved by other libraries, each in a process of its own.

What runs there, `worker.py`, `problem.py` and the modules `with_...`, needs numpy and that library alone.
"""
