"""A deployment in the report."""
