"""Classifiers that turn features into class distributions, kept as plain arrays (appendix C)."""
