"""How good and how fast it is: `python -m benchmarks NAME` prints tables, then its figures as a line of JSON."""
