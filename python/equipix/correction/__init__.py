"""Corrections: the protocol, how they are applied to arrays, and to files."""
