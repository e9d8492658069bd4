"""Statics of many poses at once."""
