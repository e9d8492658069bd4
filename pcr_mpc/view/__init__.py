"""The robot live in a browser: the real plant and the real controller behind one page, and recorded runs in it."""
