"""Frames, arrays and metadata to and from files."""
