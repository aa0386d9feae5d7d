"""Depth renderers behind one protocol."""
