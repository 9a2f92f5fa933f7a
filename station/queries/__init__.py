"""Queries of the store: means, volumes and their uncertainty, propagated from the stored covariances."""
