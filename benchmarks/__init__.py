"""Benchmarks: accuracy against simulated truth, and cost as ratios to decoding a scan."""
