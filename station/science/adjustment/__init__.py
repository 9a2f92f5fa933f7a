"""Adjustment of one scan: observations, prior, normal equations, joint solution, variance components."""
