"""Excitation signals, the plan of a sweep, and its worst case before anything moves."""
