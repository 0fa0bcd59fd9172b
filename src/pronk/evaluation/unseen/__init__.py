"""Bodies that no policy was trained for, each matched anew by its own sweep."""
