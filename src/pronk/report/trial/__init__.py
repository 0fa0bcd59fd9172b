"""The trial in the report."""
