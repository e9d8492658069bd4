"""The fastest motion along a path that is given."""
