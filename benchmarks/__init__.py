"""How good and how fast it is: `python -m benchmarks NAME` prints tables of records, and stores them if asked to.

A benchmark is a module with `PARTS`: functions from `Settings` to the records that they yield. Their docstrings say how
the values are to be read.
"""
