"""Fits of exposures until the weights are final, and their error bars."""
