"""Estimate the frequency response of each joint from a log."""
