"""Which model is enough for a scene, and what better numbers would be worth."""
