"""Scripted jump trials of policies, and what is measured in them."""
