"""Commissioning: each module is one command and one result file."""
