"""Speed, always beside a peer in the same run: `python -m benchmarks [GROUP]`, or `make benchmark [ONLY=GROUP]`."""
