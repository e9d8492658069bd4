"""Before a robot runs: a first robot, scene and tuning from a few numbers, and what can be said of them at rest."""
