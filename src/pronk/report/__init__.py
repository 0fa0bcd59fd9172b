"""Figures and the HTML page, from artefacts alone."""
